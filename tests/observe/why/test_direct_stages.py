"""``rmpa why`` of a topic whose subscribers are connected to the publisher directly."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from rmpa.observe.peer_info import CheckLevel
from rmpa.observe.snapshot import SubscriberTransport
from tests.observe.why.test_topics import PEER, ROUTE, SOURCE, Case, connected

if TYPE_CHECKING:
    from rmpa.observe.why.diagnosis import Diagnosis

HERE = SubscriberTransport(
    node="/base",
    transport="direct",
    state="direct",
    wanted="auto",
    endpoint="10.0.0.2:41234",
)
IDLE = msgspec.structs.replace(
    ROUTE, state="idle", messages=0, age=None, rate=None, period=None, lane="", md5="", transport="direct"
)


def direct(here: SubscriberTransport = HERE, *, relayed: bool = False) -> Case:
    """``/cmd`` with ``/base`` direct; with ``relayed`` beside ``/rec``, which is relayed."""
    source = msgspec.structs.replace(SOURCE, route="", messages=0)
    case = Case(source=source, source_later=source, readers=(), readers_later=())
    route = msgspec.structs.replace(IDLE, subscribers=(here,))
    case = replace(case, route=route, later=route)
    if not relayed:
        return case
    flowing, readers = Case(), (connected("/rec"),)
    assert flowing.route is not None
    assert flowing.later is not None
    both = {"transport": "both", "subscribers": (here,)}
    return replace(
        case,
        route=msgspec.structs.replace(flowing.route, **both),
        later=msgspec.structs.replace(flowing.later, **both),
        source=msgspec.structs.replace(source, route="open", messages=100),
        source_later=msgspec.structs.replace(source, route="open", messages=120),
        readers=readers,
        readers_later=readers,
        subscribers=("/base", "/rec"),
    )


def walk(case: Case) -> Diagnosis:
    (found,) = case.walk()
    return found


def stages(case: Case) -> dict[str, tuple[CheckLevel, str]]:
    found = walk(case)
    return {stage.name: (stage.level, stage.text) for stage in found.stages}


def test_a_direct_topic_flows_although_nothing_passes_the_agents() -> None:
    found = walk(direct())
    assert found.flows, found
    assert [stage.name for stage in found.stages][-3:] == ["subscriber", "transport", "connection"]
    texts = {stage.name: stage.text for stage in found.stages}
    assert texts["subscriber"] == "/base was answered the publisher's own address"
    assert texts["transport"] == "direct to 10.0.0.2:41234 for /base"
    assert texts["connection"] == (
        "/base is connected to 10.0.0.2:41234; not measured: the nodes are connected directly"
    )


def test_direct_and_relayed_subscribers_are_both_judged() -> None:
    found = walk(direct(relayed=True))
    assert found.flows, found
    names = [stage.name for stage in found.stages]
    assert names[names.index("subscriber") :] == [
        *(
            "subscriber",
            "md5",
            "transport",
            "connection",
            "route",
            "sent",
            "arrived",
            "contract",
            "reader",
        ),
    ]
    (said,) = [stage.text for stage in found.stages if stage.name == "subscriber"]
    assert said == "/rec connected to its proxy; /base was answered the publisher's own address"


def changed(one: SubscriberTransport, **changes: Any) -> SubscriberTransport:
    return msgspec.structs.replace(one, **changes)


FAILURES = {
    "not decided yet": (
        direct(changed(HERE, transport="", state="asking", endpoint="")),
        "subscriber",
        "whether it may be connected directly is not decided yet",
    ),
}


@pytest.mark.parametrize(("case", "stage", "text"), FAILURES.values(), ids=FAILURES)
def test_the_first_stage_that_fails(case: Case, stage: str, text: str) -> None:
    failed = walk(case).failed
    assert failed is not None
    assert failed.name == stage
    assert text in failed.text
    assert failed.remedy


RELAYED = {"transport": "relay", "state": "relayed", "endpoint": ""}


@pytest.mark.parametrize(
    ("changes", "level", "text"),
    [
        (
            {"condition": "caller_id", "text": "taken"},
            CheckLevel.OK,
            "relayed for /base: taken (condition caller_id)",
        ),
        (
            {"condition": "caller_id", "text": "taken", "wanted": "direct"},
            CheckLevel.WARN,
            "relayed for /base: taken (condition caller_id)",
        ),
        (
            {"condition": "transport", "text": 'it is "relay"', "wanted": "direct"},
            CheckLevel.OK,
            'relayed for /base: it is "relay" (condition transport)',
        ),
    ],
)
def test_the_transport_never_fails_and_names_the_condition(
    changes: dict[str, Any], level: CheckLevel, text: str
) -> None:
    flowing = Case()
    assert flowing.route is not None
    assert flowing.later is not None
    here = {"transport": "relay", "subscribers": (changed(HERE, **RELAYED, **changes),)}
    route, later = (msgspec.structs.replace(one, **here) for one in (flowing.route, flowing.later))
    case = Case(route=route, later=later)
    assert walk(case).flows
    assert stages(case)["transport"] == (level, text)


def test_direct_messages_go_on_without_the_peers_agent() -> None:
    unlinked = msgspec.structs.replace(PEER, state="linking", link=None, last_error="connection reset")
    found = walk(replace(direct(), peer=unlinked))
    assert found.flows, found
    assert [stage.name for stage in found.stages] == ["peer", "link", "transport", "connection"]
    assert found.stages[1].level is CheckLevel.WARN
    assert "connection reset; without its agent only what is connected directly goes on" in found.stages[1].text


def test_a_subscriber_that_cannot_be_moved_is_a_warning() -> None:
    found = walk(direct(changed(HERE, state="relayed", condition="name", text="other name")))
    assert found.flows
    (stage,) = [one for one in found.stages if one.name == "transport"]
    assert stage.level is CheckLevel.WARN
    assert "has to be relayed: other name" in stage.text
    assert "CAP_NET_ADMIN" in stage.remedy
