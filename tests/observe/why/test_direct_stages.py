"""``rmpa why`` of a topic whose subscribers are connected to the publisher directly."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from rmpa.observe.check import CheckLevel
from rmpa.observe.snapshot import DirectFigures, SubscriberTransport
from tests.observe.why.test_topics import PEER, ROUTE, SOURCE, Case, connected

if TYPE_CHECKING:
    from rmpa.observe.why.diagnosis import Diagnosis

HERE = SubscriberTransport(
    node="/base",
    transport="direct",
    state="direct",
    wanted="auto",
    endpoint="10.0.0.2:41234",
    connected=True,
    figures=DirectFigures(messages=30, bytes=3000, dropped=0, rate=20.0, bandwidth=2000.0, window=1.5),
)
THERE = SubscriberTransport(
    node="/base",
    transport="direct",
    state="granted",
    endpoint="41234",
    connected=True,
    figures=DirectFigures(messages=31, bytes=3100, rate=20.0, bandwidth=2000.0, window=1.5),
)
IDLE = msgspec.structs.replace(
    ROUTE, state="idle", messages=0, age=None, rate=None, period=None, lane="", md5="", transport="direct"
)


def direct(
    here: SubscriberTransport = HERE, there: SubscriberTransport | None = THERE, *, relayed: bool = False
) -> Case:
    """``/cmd`` with ``/base`` direct; with ``relayed`` beside ``/rec``, which is relayed."""
    source = msgspec.structs.replace(SOURCE, route="", messages=0, direct=(there,) if there is not None else ())
    case = Case(source=source, source_later=source, readers=(), readers_later=())
    route = msgspec.structs.replace(IDLE, subscribers=(here,))
    case = replace(case, route=route, later=route)
    if not relayed:
        return case
    flowing, readers = Case(), (connected("/rec", messages=100),)
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
    assert [stage.name for stage in found.stages][-5:] == ["subscriber", "transport", "connection", "sent", "arrived"]
    texts = {stage.name: stage.text for stage in found.stages}
    assert texts["subscriber"] == "/base was answered the publisher's own address"
    assert texts["transport"] == "direct to 10.0.0.2:41234 for /base"
    assert texts["connection"] == "/base is connected to 10.0.0.2:41234"
    assert texts["sent"] == "31 messages to /base, as /joy counts"
    assert texts["arrived"] == "30 messages, 20.0 Hz, as /base counts"


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
            "arrived",
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


def counts(one: SubscriberTransport, **changes: Any) -> SubscriberTransport:
    assert one.figures is not None
    return changed(one, figures=msgspec.structs.replace(one.figures, **changes))


MUTE = {"figures": None, "unmeasured": "/base does not tell its figures: no answer"}
FAILURES = {
    "connection gone": (direct(changed(HERE, connected=False)), "connection", "no connection to 10.0.0.2:41234"),
    "nothing published": (direct(there=counts(THERE, messages=0)), "sent", "has published nothing since"),
    "does not read": (
        direct(counts(HERE, rate=0.0, bandwidth=0.0)),
        "arrived",
        "/base has received nothing for 1.5 s; 30 messages were sent meanwhile",
    ),
    "never read": (
        direct(counts(HERE, messages=0, bytes=0, rate=0.0, bandwidth=0.0)),
        "arrived",
        "/base has received nothing; 30 messages were sent meanwhile",
    ),
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


@pytest.mark.parametrize("name", ["connection gone", "does not read", "never read"])
def test_a_direct_subscriber_in_trouble_is_a_warning_beside_relayed_ones(name: str) -> None:
    case, stage, _ = FAILURES[name]
    assert case.route is not None
    found = walk(direct(case.route.subscribers[0], relayed=True))
    assert found.flows
    assert (CheckLevel.WARN, stage) in {(one.level, one.name) for one in found.stages}


UNTOLD = {
    "an older agent there": (direct(there=None), "sent", "/joy does not tell what it has sent"),
    "a publisher that does not tell": (
        direct(there=changed(THERE, figures=None, unmeasured="/joy cannot tell its figures")),
        "sent",
        "/joy cannot tell its figures",
    ),
    "a subscriber that does not tell": (direct(changed(HERE, **MUTE)), "arrived", MUTE["unmeasured"]),
    "neither node nor kernel": (direct(changed(HERE, connected=None, **MUTE)), "connection", MUTE["unmeasured"]),
}


@pytest.mark.parametrize(("case", "stage", "text"), UNTOLD.values(), ids=UNTOLD)
def test_what_a_node_does_not_tell_is_unknown_and_no_failure(case: Case, stage: str, text: str) -> None:
    assert walk(case).flows
    assert stages(case)[stage] == (CheckLevel.UNKNOWN, text)


def test_a_node_that_does_not_answer_may_be_stopped() -> None:
    case = direct(changed(HERE, **MUTE, silent=True))
    assert walk(case).flows
    (stage,) = [one for one in walk(case).stages if one.name == "arrived"]
    assert (stage.level, stage.text) == (CheckLevel.WARN, MUTE["unmeasured"])
    assert "rosnode ping /base" in stage.remedy


def test_a_full_queue_of_the_subscriber_is_a_warning() -> None:
    level, text = stages(direct(counts(HERE, dropped=7)))["arrived"]
    assert (level, text) == (CheckLevel.WARN, "/base has dropped 7 of 30 messages by its own queue")


def test_a_slow_topic_is_not_taken_for_a_silent_one() -> None:
    slow = direct(counts(HERE, rate=0.0, bandwidth=0.0), counts(THERE, rate=0.6))
    assert walk(slow).flows, "one message may be on its way"


RELAYED = {"transport": "relay", "state": "relayed", "endpoint": "", "connected": None, "figures": None}


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
    assert [stage.name for stage in found.stages] == ["peer", "link", "transport", "connection", "sent", "arrived"]
    assert found.stages[1].level is CheckLevel.WARN
    assert "connection reset; without its agent only what is connected directly goes on" in found.stages[1].text
    broken = walk(replace(direct(changed(HERE, connected=False)), peer=unlinked))
    assert broken.failed is not None
    assert broken.failed.name == "connection"


def test_a_subscriber_that_cannot_be_moved_is_a_warning() -> None:
    stuck = changed(HERE, state="relayed", condition="name", text="other name", stuck="Operation not permitted")
    found = walk(direct(stuck))
    assert found.flows
    (stage,) = [one for one in found.stages if one.name == "transport"]
    assert stage.level is CheckLevel.WARN
    assert "cannot be ended (Operation not permitted)" in stage.text
    assert "CAP_NET_ADMIN" in stage.remedy
