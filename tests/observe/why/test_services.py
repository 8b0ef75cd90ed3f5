"""``rmpa why`` of a service, and of a module: each stage by itself. The golden file has what is said."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import msgspec
import pytest

from rmpa.core.facts import BoundInfo, FilesInfo, LaneInfo, ServiceInfo
from rmpa.observe.check import Check, CheckLevel
from rmpa.observe.snapshot import ModuleFacts, PeerInfo
from rmpa.observe.why.diagnosis import Diagnosis, ServiceAtServer
from rmpa.observe.why.services import ServiceHere, diagnose_module, diagnose_service
from tests.observe.samples import SNAPSHOT
from tests.observe.why.test_topics import LINK, PEER, unlinked

BEGIN = (Check("peer", CheckLevel.OK, "known"), Check("link", CheckLevel.OK, "linked"))
THERE = ServiceAtServer(node="/arm", service="/move", rule="services.allow has '/**'")
INFO = ServiceInfo(name="/move", node="/arm", direction="in", peer="robot", calls=3)
HERE = ServiceHere(INFO, registered=True, answer="a/Move, md5 123")
ORDER = ("peer", "link", "server", "policy there", "offer", "shown", "graph", "transport", "answer", "calls")


def walk(
    here: ServiceHere = HERE, there: ServiceAtServer | None = THERE, begin: tuple[Check, ...] = BEGIN
) -> Diagnosis:
    refusal = "" if there else "it is older"
    return diagnose_service(begin, "base", "robot", "/move", "/move", here, there, refusal)


def told(**changes: object) -> ServiceHere:
    """What is known here, with other facts in the snapshot."""
    return replace(HERE, info=msgspec.structs.replace(INFO, **changes))


def server(**changes: object) -> ServiceAtServer:
    return msgspec.structs.replace(THERE, **changes)


LOOPBACK = {"condition": "listening", "relayed_because": "on loopback only"}
FLOWING: dict[str, tuple[ServiceHere, ServiceAtServer | None, str]] = {
    # The facts at both ends, and the stage that warns or is unknown.
    "a service": (HERE, THERE, ""),
    "direct calls": (told(wanted="auto", address="rosrpc://10.0.0.1:9"), THERE, ""),
    "direct calls are asked for": (told(wanted="direct"), THERE, ""),
    "relayed by a condition": (told(wanted="auto", **LOOPBACK), THERE, ""),
    "relayed although direct is wanted": (told(wanted="direct", **LOOPBACK), THERE, "transport"),
    "failed calls": (told(failed=1, problem="took more than 60 s"), THERE, "calls"),
    "a client of another definition": (replace(told(problem="/client wants 456"), mismatched=True), THERE, "calls"),
    "an agent that does not answer": (HERE, None, "server"),
}
FAILURES: dict[str, tuple[ServiceHere, ServiceAtServer | None, str]] = {
    # The facts at both ends, and the stage that fails.
    "none provides it": (HERE, ServiceAtServer(), "server"),
    "nearly its name": (HERE, ServiceAtServer(similar="/mov"), "server"),
    "its server is stuck": (HERE, server(refusal="no answer within 2 s"), "server"),
    "an older agent": (ServiceHere(), None, "server"),
    "policy there": (HERE, server(crosses=False, rule="services.deny has '/move'"), "policy there"),
    "not offered yet": (ServiceHere(), THERE, "offer"),
    "policy here": (told(hidden="policy: services.deny has '/move'"), THERE, "shown"),
    "another provider": (told(hidden="/local of this module provides it itself"), THERE, "shown"),
    "not registered": (replace(HERE, registered=False), THERE, "graph"),
    "no answer": (replace(HERE, answer="", refusal="robot: its server has gone"), THERE, "answer"),
}


@pytest.mark.parametrize(("here", "there", "stage"), FAILURES.values(), ids=FAILURES)
def test_the_first_stage_that_fails(here: ServiceHere, there: ServiceAtServer | None, stage: str) -> None:
    found = walk(here, there)
    assert not found.flows
    assert found.failed is not None
    assert found.failed is found.stages[-1]
    assert found.failed.name == stage
    assert found.failed.remedy


def test_every_stage_behind_the_link_can_fail_but_transport_and_calls() -> None:
    assert {stage for _, _, stage in FAILURES.values()} == set(ORDER) - {"peer", "link", "transport", "calls"}


def test_without_a_link_nothing_else_is_judged() -> None:
    begin = (BEGIN[0], Check("link", CheckLevel.FAIL, "no link", "plug it in"))
    assert walk(begin=begin).stages == begin


LANES = (LaneInfo(name="express", connected=True), LaneInfo(name="bulk", connected=True))
UNNEEDED = (LANES[0], LaneInfo(name="bulk", connected=False, unneeded=True))
CUT = (LANES[0], LaneInfo(name="bulk", connected=False, queued=9))
FILES = FilesInfo(open=60, limit=1024, hard=1024, reserved=0)
TOLD = ModuleFacts(version=SNAPSHOT.agent.version, cpu=3.0, files=FILES)


def module(
    agent: ModuleFacts | None = TOLD, link: dict[str, Any] | None = None, name: str = "joystick", **changes: Any
) -> Diagnosis:
    linked = msgspec.structs.replace(LINK, **{"lanes": LANES, "clock_offset": 0.001, **(link or {})})
    return asked(msgspec.structs.replace(PEER, link=linked, **changes), name, agent)


def asked(peer: PeerInfo, name: str = "joystick", agent: ModuleFacts | None = None) -> Diagnosis:
    refusal = "" if agent else "it does not know the question"
    return diagnose_module(msgspec.structs.replace(SNAPSHOT, peers=(peer,)), name, agent, refusal)


def agent(**changes: Any) -> ModuleFacts:
    return msgspec.structs.replace(TOLD, **changes)


MODULES: dict[str, tuple[Diagnosis, list[tuple[str, str]]]] = {
    # What is found, and the stages that are not well.
    "a module": (module(), []),
    "a bulk lane that nothing wants": (module(link={"lanes": UNNEEDED}), []),
    "a lane that is cut": (module(link={"lanes": CUT}), [("lanes", "warn")]),
    "a link that drops": (module(link={"dropped": 4}), [("lanes", "warn")]),
    "another version": (module(agent(version="0.0.1")), [("answer", "warn")]),
    "an agent that does not tell": (module(None), [("answer", "unknown")]),
    "a clock ahead": (module(link={"clock_offset": 2.0}), [("clock", "warn")]),
    "a busy agent": (module(agent(cpu=97.0)), [("load", "warn")]),
    "few files": (module(agent(files=FilesInfo(open=1000, limit=1024, hard=1024, reserved=0))), [("files", "warn")]),
    "a limit": (
        module(beyond=(BoundInfo(kind="nodes", limit=2, hidden=1, text="1 node hides; raise it"),)),
        [("limits", "warn")],
    ),
    "no topics": (module(topics_in=0), [("offers", "warn")]),
    "no link": (asked(unlinked("linking", last_error="connection refused")), [("link", "fail")]),
    "an unknown module": (module(name="arm"), [("peer", "fail")]),
    "this module": (module(name=SNAPSHOT.agent.name), []),
}


@pytest.mark.parametrize(("found", "stages"), MODULES.values(), ids=MODULES)
def test_the_stages_of_a_module_that_are_not_well(found: Diagnosis, stages: list[tuple[str, str]]) -> None:
    bad = [stage for stage in found.stages if stage.level is not CheckLevel.OK]
    assert [(stage.name, stage.level.value) for stage in bad] == stages
    assert all(stage.remedy or stage.level is CheckLevel.UNKNOWN for stage in bad)
    assert found.flows is all(level != "fail" for _, level in stages)
    assert (found.kind, found.to) == ("module", SNAPSHOT.agent.name)
