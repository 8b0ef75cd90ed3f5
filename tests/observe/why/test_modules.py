"""``rmpa why --module``: each stage by itself, from facts that differ in one thing from those of a healthy link."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from rmpa.observe.peer_info import BoundInfo, LaneInfo, PeerAgent, PeerInfo
from rmpa.observe.why.services import diagnose_module
from tests.observe.samples import SNAPSHOT
from tests.observe.why.test_topics import LINK, PEER

if TYPE_CHECKING:
    from rmpa.observe.snapshot import Snapshot
    from rmpa.observe.why.diagnosis import Diagnosis

LANES = (LaneInfo(name="express", connected=True), LaneInfo(name="bulk", connected=True))
TOLD = PeerAgent(version=SNAPSHOT.agent.version, cpu=3.0, files_open=60, files_limit=1024)
replace = msgspec.structs.replace


def peer(link: dict[str, Any] | None = None, **changes: Any) -> PeerInfo:
    return replace(PEER, link=replace(LINK, **{"lanes": LANES, "clock_offset": 0.001, **(link or {})}), **changes)


def snapshot(*peers: PeerInfo) -> Snapshot:
    return replace(SNAPSHOT, peers=peers)


def stages(found: Diagnosis) -> list[tuple[str, str]]:
    return [(stage.name, stage.level.value) for stage in found.stages]


def test_a_healthy_module_passes_every_stage() -> None:
    found = diagnose_module(snapshot(peer()), "joystick", TOLD)
    assert (found.kind, found.flows, found.to) == ("module", True, SNAPSHOT.agent.name)
    assert stages(found) == [(name, "ok") for name in ("peer", "link", "lanes", "answer", "clock", "load", "offers")]


def test_a_bulk_lane_that_nothing_wants_is_no_trouble() -> None:
    lanes = (LANES[0], LaneInfo(name="bulk", connected=False, unneeded=True))
    found = diagnose_module(snapshot(peer({"lanes": lanes})), "joystick", TOLD)
    assert {stage.level.value for stage in found.stages} == {"ok"}
    (text,) = [stage.text for stage in found.stages if stage.name == "lanes"]
    assert "the bulk lane is connected when a message wants it" in text


@pytest.mark.parametrize(
    ("changed", "told", "stage", "text"),
    [
        (peer({"lanes": (LANES[0], LaneInfo(name="bulk", connected=False, queued=9))}), TOLD, "lanes", "9 bytes"),
        (peer({"dropped": 4}), TOLD, "lanes", "4 messages were dropped"),
        (peer(), replace(TOLD, version="0.0.1"), "answer", "is of version 0.0.1"),
        (peer({"clock_offset": 2.0}), TOLD, "clock", "2000.0 ms ahead"),
        (peer(), replace(TOLD, cpu=97.0), "load", "97 % of a core"),
        (peer(), replace(TOLD, files_open=1000), "files", "1000 of 1024"),
        (peer(beyond=(BoundInfo(kind="nodes", limit=2, hidden=1, text="1 node hides; raise it"),)), TOLD,
         "limits", "1 node hides"),
        (peer(topics_in=0), TOLD, "offers", "offers 0 topics"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_warned_of_with_a_remedy(changed: PeerInfo, told: PeerAgent, stage: str, text: str) -> None:
    found = diagnose_module(snapshot(changed), "joystick", told)
    (warned,) = [each for each in found.stages if each.level.value == "warn"]
    assert warned.name == stage
    assert text in warned.text
    assert warned.remedy
    assert found.flows


def test_a_peer_that_does_not_tell_of_itself_is_no_failure() -> None:
    found = diagnose_module(snapshot(peer()), "joystick", None, "it does not know the question 'agent.info'")
    assert ("answer", "unknown") in stages(found)
    assert found.flows


def test_a_peer_without_a_link_fails_there() -> None:
    lost = replace(PEER, state="linking", link=None, last_error="connection refused")
    found = diagnose_module(snapshot(lost), "joystick")
    assert stages(found) == [("peer", "ok"), ("link", "fail")]
    assert "connection refused" in found.stages[-1].text


def test_an_unknown_module_and_this_one_are_told() -> None:
    assert stages(diagnose_module(snapshot(), "arm")) == [("peer", "fail")]
    assert "is this module" in diagnose_module(snapshot(), SNAPSHOT.agent.name).stages[0].text
