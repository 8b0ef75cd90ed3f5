"""``rmpa why``: each stage by itself, from two agents' words that differ in one thing from those of what flows."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.config import limits as config_limits
from rmpa.observe import limits as observe_limits
from rmpa.observe.peer_info import Check, CheckLevel, LinkInfo, PeerInfo
from rmpa.observe.snapshot import FilesInfo, RouteInfo, SampleSpread, Snapshot
from rmpa.observe.why.diagnosis import Diagnosis, PublisherReport, TopicAtPublisher
from rmpa.observe.why.stages import Arrival, Ends, diagnose_topic
from tests.observe.samples import SNAPSHOT

if TYPE_CHECKING:
    from collections.abc import Callable

ORDER = (
    *("peer", "link", "publisher", "policy there", "reachable", "offer", "limit", "policy here", "type", "graph"),
    *("subscriber", "md5", "transport", "route", "sent", "arrived", "contract", "reader"),
)
ONLY_FAILS = ("reachable", "limit")
"""Stages that are shown only where the walk ends at them."""
LINK = LinkInfo(remote="10.0.0.2:40002", dialled=True, up_ago=60.0, rtt=0.0004, heard_ago=0.1)
PEER = PeerInfo(
    name="joystick",
    guid="10.0.0.2:40002#1",
    instance="11" * 16,
    state="linked",
    since_ago=60.0,
    source="multicast",
    link=LINK,
    topics_in=3,
)
ROUTE = RouteInfo(
    peer="joystick",
    node="/joy",
    direction="in",
    state="open",
    type="sensor_msgs/Joy",
    md5="5a9ea5f83505693b71e785041e67a8bb",
    messages=100,
    age=0.05,
    rate=20.0,
    period=SampleSpread(count=99, mean=0.05, sd=0.001, min=0.049, max=0.052, p50=0.05, p99=0.0515),
    lane="express",
)
SOURCE = PublisherReport(
    node="/joy", type="sensor_msgs/Joy", rule="bridge.allow has '/**'", route="open", messages=100
)
ROUTE_LATER = msgspec.structs.replace(ROUTE, messages=120, age=0.03)
SOURCE_LATER = msgspec.structs.replace(SOURCE, messages=120)


Reader = tuple[str, int, int]


def connected(node: str, waiting: int = 0, dropped: int = 0) -> Reader:
    return node, waiting, dropped


@dataclass(frozen=True)
class Case:
    """Both sides of ``/cmd``, which flows unless something is changed."""

    peer: PeerInfo | None = PEER
    route: RouteInfo | None = ROUTE
    later: RouteInfo | None = ROUTE_LATER
    source: PublisherReport | None = SOURCE
    source_later: PublisherReport | None = SOURCE_LATER
    there: TopicAtPublisher | None = field(default_factory=TopicAtPublisher)
    refusal: str = ""
    registered: bool = True
    conflict: bool = False
    subscribers: tuple[str, ...] = ("/base",)
    readers: tuple[Reader, ...] = (connected("/base"),)
    readers_later: tuple[Reader, ...] | None = (connected("/base"),)
    mismatches: tuple[str, ...] = ()
    known: bool = True
    wire: str = "/cmd"
    files: FilesInfo | None = None
    stranger: PeerInfo | None = None

    def ends(self, route: RouteInfo | None, source: PublisherReport | None, readers: tuple[Reader, ...]) -> Ends:
        snapshot = Snapshot(
            agent=msgspec.structs.replace(SNAPSHOT.agent, files=self.files),
            taken=0.0,
            peers=(self.peer,) if self.peer else (),
            strangers=(self.stranger,) if self.stranger else (),
        )
        there = self.there
        if there is not None and source is not None:
            there = msgspec.structs.replace(there, sources=(source,))
        arrivals = {}
        if route is not None and self.known:
            arrivals["/joy"] = Arrival(
                route,
                registered=self.registered,
                cause="conflict" if self.conflict else "",
                readers=dict(enumerate(readers)),
                mismatches=self.mismatches,
            )
        return Ends(snapshot, "/cmd", self.wire, self.subscribers, arrivals, there, self.refusal)

    def walk(self, peer: str = "joystick") -> tuple[Diagnosis, ...]:
        first = self.ends(self.route, self.source, self.readers)
        if self.readers_later is None:
            return diagnose_topic(first, peer)
        return diagnose_topic(first, peer, self.ends(self.later, self.source_later, self.readers_later))


def one(case: Case, peer: str = "joystick") -> Diagnosis:
    (diagnosis,) = case.walk(peer)
    return diagnosis


def route(**changes: object) -> dict[str, Any]:
    """The route at both looks."""
    changed = msgspec.structs.replace(ROUTE, **changes)
    return {"route": changed, "later": changed}


def test_a_flowing_topic_passes_all_stages() -> None:
    found = one(Case())
    assert found.flows
    assert found.failed is None
    assert [stage.name for stage in found.stages] == [name for name in ORDER if name not in ONLY_FAILS]
    assert {stage.level for stage in found.stages} == {CheckLevel.OK}
    assert (found.name, found.peer, found.to, found.node) == ("/cmd", "joystick", "base", "/joy")
    by_name = {stage.name: stage.text for stage in found.stages}
    assert by_name["arrived"] == "120 messages, the last 0.03 s ago, 20.0 Hz"
    assert by_name["reader"] == "/base takes them"


def test_two_modules_of_one_name_are_told_and_what_they_publish_arrives() -> None:
    twin = msgspec.structs.replace(PEER, conflicts=("two modules are named joystick; rename one",))
    found = one(Case(peer=twin))
    assert found.flows
    stage = found.stages[0]
    assert (stage.name, stage.level, stage.remedy) == ("peer", CheckLevel.WARN, "rename one")


def test_a_module_of_another_mesh_is_told_as_such() -> None:
    told = "not of this mesh: it has not joined; let it join"
    stranger = msgspec.structs.replace(PEER, state="foreign", link=None, last_error=told)
    found = one(Case(peer=None, stranger=stranger))
    (stage,) = found.stages
    assert (stage.name, stage.level) == ("peer", CheckLevel.FAIL)
    assert (stage.text, stage.remedy) == ("joystick is not of this mesh: it has not joined", "let it join")


FAILURES: dict[str, tuple[Case, str, str, str]] = {
    # What is different: the stage that fails, a part of its text, a part of its remedy.
    "unknown peer": (Case(peer=None), "peer", "base knows no peer 'joystick' (domain 3", "rmpa doctor"),
    "conflict": (
        Case(peer=msgspec.structs.replace(PEER, state="conflict", conflicts=("shares its address",))),
        "peer",
        "shares its address",
        "--name",
    ),
    "shared address": (
        Case(
            peer=msgspec.structs.replace(
                PEER, state="conflict", conflicts=("its address is also b's; give one another",)
            )
        ),
        "peer",
        "its address is also b's",
        "give one another",
    ),
    "unreachable": (
        Case(source=msgspec.structs.replace(SOURCE, offered=False, unreachable="http://nosuch:1/: no such name")),
        "reachable",
        "/joy is registered on joystick, but cannot be reached at http://nosuch:1/: no such name",
        "ROS_IP=127.0.0.1",
    ),
    "not linked": (
        Case(peer=msgspec.structs.replace(PEER, state="linking", link=None, last_error="timed out")),
        "link",
        "joystick is linking: timed out",
        "firewall",
    ),
    "only beacons": (
        Case(peer=msgspec.structs.replace(PEER, state="linking", link=None, beacon_ago=1.5)),
        "link",
        "its beacons come (the last 1.5 s ago), but there is no TCP connection",
        "TCP to 10.0.0.2:40002",
    ),
    "refused": (
        Case(peer=msgspec.structs.replace(PEER, state="refused", link=None, last_error="domain 4 is not 3")),
        "link",
        "domain 4 is not 3",
        "do what the text says",
    ),
    "nobody publishes": (Case(source=None, route=None), "publisher", "no node of joystick publishes", "start its"),
    "nearly its name": (
        Case(source=None, route=None, there=TopicAtPublisher(similar="/cmd_vel")),
        "publisher",
        "no node of joystick publishes /cmd",
        "did you mean /cmd_vel?",
    ),
    "only subscribed there": (
        Case(source=None, route=None, there=TopicAtPublisher(subscribers=("/echo",))),
        "publisher",
        "/echo there only subscribe",
        "start its",
    ),
    "an older agent, nothing offered": (
        Case(route=None, there=None, refusal="it does not know the question"),
        "publisher",
        "does not tell why (it does not know the question)",
        "rostopic info",
    ),
    "policy there": (
        Case(source=msgspec.structs.replace(SOURCE, crosses=False, rule="bridge.deny has '/cmd'"), route=None),
        "policy there",
        "joystick keeps it at home: bridge.deny has '/cmd'",
        "rmpa.toml of joystick",
    ),
    "built in": (
        Case(source=msgspec.structs.replace(SOURCE, crosses=False, rule="built in: time stays home"), route=None),
        "policy there",
        "time stays home",
        "another name",
    ),
    "no type": (
        Case(source=msgspec.structs.replace(SOURCE, type="*"), route=None),
        "offer",
        "what type",
        "registers",
    ),
    "too many": (
        Case(source=msgspec.structs.replace(SOURCE, offered=False, beyond=70), route=None),
        "offer",
        "does not offer it: it has more topics than limits.topics = 70",
        "bridge.deny",
    ),
    "too long a name": (
        Case(source=msgspec.structs.replace(SOURCE, offered=False), route=None),
        "offer",
        "does not offer it: its name or type",
        str(config_limits.CROSSING_NAME_MAX),
    ),
    "no place for its node": (
        Case(**route(state="hidden", problem="joystick has more nodes than limits.nodes = 2", limit="nodes")),
        "limit",
        "more nodes than limits.nodes = 2",
        "raise limits.nodes",
    ),
    "not told yet": (Case(route=None), "offer", "has not come here (3 topics of joystick have)", "both logs"),
    "policy here": (
        Case(**route(state="hidden", problem="bridge.deny has '/cmd'")),
        "policy here",
        "does not take it: bridge.deny has '/cmd'",
        "rmpa reload",
    ),
    "type": (
        Case(**route(state="hidden", problem="its type is a/B, but c/D here; rename one"), conflict=True),
        "type",
        "its type is a/B, but c/D here",
        "rename one",
    ),
    "not registered": (Case(registered=False), "graph", "/rmpa/joystick/joy is not in the local graph", "5 s"),
    "no descriptor for its proxy": (
        Case(registered=False, **route(state="idle", problem="no file descriptor is left for its proxy; raise it")),
        "graph",
        "of /cmd: no file descriptor is left for its proxy",
        "raise it",
    ),
    "no descriptor for its subscriber": (
        Case(
            readers=(),
            files=FilesInfo(
                open=60, limit=64, hard=64, reserved=16, problem="node /x has to wait: none left; raise it"
            ),
            **route(state="idle"),
        ),
        "subscriber",
        "the agent has no file descriptor to accept it with: node /x has to wait: none left",
        "raise it",
    ),
    "not connected": (
        Case(readers=(), **route(state="idle")),
        "subscriber",
        "/base subscribes, but has not connected",
        "ROS_IP",
    ),
    "md5": (
        Case(readers=(), mismatches=("/base: wants 1234",), **route(state="idle")),
        "md5",
        "/base: wants 1234",
        "one version of the message",
    ),
    "publisher does not answer": (
        Case(
            **route(state="opening", md5=""),
            source=msgspec.structs.replace(SOURCE, route="opening"),
            source_later=msgspec.structs.replace(SOURCE, route="opening"),
        ),
        "route",
        "waits for the publisher /joy to answer",
        "rosnode ping /joy",
    ),
    "peer does not answer": (Case(**route(state="opening", md5="")), "route", "has not answered", "log there"),
    "route closed": (
        Case(**route(state="waiting", md5="", problem="its publisher refuses: no")),
        "route",
        "waiting: its publisher refuses: no",
        "tried again by itself",
    ),
    "nothing published": (
        Case(
            **route(messages=0, age=None, rate=None, period=None),
            source=msgspec.structs.replace(SOURCE, messages=0),
            source_later=msgspec.structs.replace(SOURCE, messages=0),
        ),
        "sent",
        "/joy is connected, and has published nothing since",
        "rostopic hz /cmd",
    ),
    "too long": (
        Case(
            **route(messages=0, age=None, rate=None, period=None),
            source=msgspec.structs.replace(SOURCE, messages=0, oversized=4, oversized_bytes=270_000_000),
            source_later=msgspec.structs.replace(SOURCE, messages=0, oversized=5, oversized_bytes=270_000_000),
        ),
        "sent",
        "5 messages of its publisher /joy are too long, the last has 270000000 bytes, and at most 268435452 cross",
        "send them in parts, or compressed",
    ),
    "nothing arrives": (
        Case(**route(messages=0, age=None, rate=None, period=None)),
        "arrived",
        "joystick has sent 20 meanwhile, and none arrived at base",
        "max_rate",
    ),
    "nothing arrives any more": (
        Case(later=ROUTE, source_later=msgspec.structs.replace(SOURCE, messages=120, dropped=20)),
        "arrived",
        "(20 were given up over there)",
        "link too slow",
    ),
    "silent": (
        Case(**route(age=8.0), source_later=SOURCE),
        "arrived",
        "nothing for 8.0 s; until then a message came every 52 ms at the latest",
        "fallen silent",
    ),
    "readers have left": (Case(readers_later=()), "reader", "have just left", "again"),
    "reader stuck": (
        Case(
            readers=(connected("/base", waiting=70_000),),
            readers_later=(connected("/base", waiting=90_000, dropped=3),),
        ),
        "reader",
        "/base (90000 B wait, 3 dropped) does not read",
        "callbacks",
    ),
}


@pytest.mark.parametrize(("case", "stage", "text", "remedy"), FAILURES.values(), ids=FAILURES)
def test_the_first_stage_that_fails(case: Case, stage: str, text: str, remedy: str) -> None:
    found = one(case)
    assert not found.flows
    assert found.failed is not None
    assert found.failed is found.stages[-1], "nothing behind it is looked at"
    assert found.failed.name == stage
    assert text in found.failed.text
    assert remedy in found.failed.remedy
    # The stages before it are those of a topic that flows; md5 is only there where something is known of it.
    names = [s.name for s in found.stages]
    assert names == [name for name in ORDER if name in names]
    missing = set(ORDER[: ORDER.index(stage)]) - set(names)
    assert missing <= {"md5", *ONLY_FAILS}


def test_a_topic_that_no_node_subscribes_to_has_no_fault() -> None:
    found = one(Case(subscribers=(), readers=(), **route(state="idle")))
    assert found.flows
    assert found.unasked
    assert found.failed is None
    last = found.stages[-1]
    assert (last.text, last.remedy) == (
        "no node here subscribes to /cmd, so nothing is sent",
        "to try it: rmpa topic echo /cmd",
    )


def test_every_stage_can_fail_but_transport_and_contract() -> None:
    assert {stage for _, stage, _, _ in FAILURES.values()} == set(ORDER) - {"contract", "transport"}


WARNINGS: dict[str, tuple[Case, str, str]] = {
    "a link that is silent": (
        Case(peer=msgspec.structs.replace(PEER, link=msgspec.structs.replace(LINK, heard_ago=0.8))),
        "link",
        "silent for 0.8 s",
    ),
    "a link at rest that is silent": (
        Case(peer=msgspec.structs.replace(PEER, link=msgspec.structs.replace(LINK, heard_ago=8.2, rests=True))),
        "link",
        "silent for 8.2 s",
    ),
    "one was refused": (Case(mismatches=("/old: wants 1234",)), "md5", "/old: wants 1234"),
    "dropped there": (
        Case(source_later=msgspec.structs.replace(SOURCE, messages=120, dropped=2)),
        "sent",
        "2 given up over there",
    ),
    "some too long": (
        Case(source_later=msgspec.structs.replace(SOURCE, messages=120, oversized=1, oversized_bytes=270_000_000)),
        "sent",
        "1 messages of its publisher /joy are too long, the last has 270000000 bytes, and at most 268435452 cross",
    ),
    "given up": (
        Case(source_later=msgspec.structs.replace(SOURCE, messages=120, lost=7046)),
        "sent",
        "7046 of them given up, while joystick had no link to this module",
    ),
    "few messages": (
        Case(**route(messages=1, age=30.0, rate=None, period=None), source_later=SOURCE),
        "arrived",
        "1 messages, the last 30.00 s ago",
    ),
    "contract": (
        Case(later=msgspec.structs.replace(ROUTE, messages=120, lost=3, events={"deadline_missed": 2})),
        "contract",
        "3 lost, deadline missed 2 times",
    ),
    "one reader of two is stuck": (
        Case(
            readers=(
                connected("/base"),
                connected("/slow", waiting=1),
            ),
            readers_later=(
                connected("/base"),
                connected("/slow", waiting=1),
            ),
        ),
        "reader",
        "/slow (1 B wait, 0 dropped) does not keep up",
    ),
    "a reader was slow": (
        Case(readers_later=(connected("/base", dropped=9),)),
        "reader",
        "/base has missed 9",
    ),
}


@pytest.mark.parametrize(("case", "stage", "text"), WARNINGS.values(), ids=WARNINGS)
def test_warnings_of_a_flowing_topic(case: Case, stage: str, text: str) -> None:
    found = one(case)
    assert found.flows
    warned = [s for s in found.stages if s.level is CheckLevel.WARN]
    assert [s.name for s in warned] == [stage]
    assert text in warned[0].text


def test_bytes_that_wait_once_are_no_fault() -> None:
    found = one(Case(readers_later=(connected("/base", waiting=70_000),)))
    assert found.stages[-1].level is CheckLevel.OK


def test_stages_are_unknown_without_an_answer() -> None:
    found = one(Case(there=None, refusal="it is older"))
    assert found.flows
    unknown = [stage.name for stage in found.stages if stage.level is CheckLevel.UNKNOWN]
    assert unknown == ["publisher", "policy there", "sent"]


def test_a_latched_topic_of_one_old_message_flows() -> None:
    quiet = route(messages=1, age=3600.0, rate=None, period=None, latched=True)
    found = one(Case(**quiet, source_later=SOURCE))
    assert {stage.level for stage in found.stages} == {CheckLevel.OK}


def test_a_message_that_is_on_its_way_is_not_missing() -> None:
    found = one(Case(later=ROUTE, source_later=msgspec.structs.replace(SOURCE, messages=101)))
    assert found.flows


def test_a_topic_that_is_thinned_out_is_not_missing() -> None:
    thin = msgspec.structs.replace(ROUTE, contract={"max_rate": 0.5})
    assert one(Case(route=thin, later=thin)).flows
    quick = msgspec.structs.replace(ROUTE, contract={"max_rate": 10.0})
    assert not one(Case(route=quick, later=quick)).flows


def test_each_publisher_has_its_diagnosis() -> None:
    second = msgspec.structs.replace(SOURCE, node="/second", crosses=False, rule="no")
    there = TopicAtPublisher(sources=(SOURCE, second))
    first, other = Case(there=there, source=None, source_later=None).walk()
    assert (first.node, first.flows) == ("/joy", True)
    assert (other.node, other.flows) == ("/second", False)
    assert other.failed is not None
    assert other.failed.name == "policy there"


def test_the_number_of_diagnoses_is_bounded() -> None:
    many = tuple(msgspec.structs.replace(SOURCE, node=f"/n{i}") for i in range(10 * observe_limits.WHY_SOURCES_MAX))
    found = Case(there=TopicAtPublisher(sources=many), source=None, source_later=None).walk()
    assert len(found) == observe_limits.WHY_SOURCES_MAX


def test_a_peer_is_found_by_guid_and_a_typo_gets_a_hint() -> None:
    assert one(Case(), "10.0.0.2:40002").flows
    assert one(Case(), "10.0.0.2:40002#1").peer == "joystick"
    found = one(Case(), "joystik")
    assert found.failed is not None
    assert found.failed.remedy.startswith("did you mean joystick?")


def test_a_relayed_module_has_no_link_of_its_own() -> None:
    relayed = msgspec.structs.replace(PEER, name="arm", state="relayed", via="joystick", link=None)
    found = one(Case(peer=relayed), "arm")
    assert found.flows
    assert found.stages[1].text == "no link of its own; joystick passes on what it publishes"
    # What the relay brings of other modules is not this one's.
    nothing = one(Case(peer=relayed, known=False, source=None, source_later=None), "arm")
    assert nothing.failed is not None
    assert nothing.failed.name == "publisher"


def test_names_at_both_ends_are_shown() -> None:
    source = msgspec.structs.replace(SOURCE, topic="/joy/stick")
    found = one(Case(**route(wire="/stick"), source=source, wire="/stick", readers_later=None))
    texts = {stage.name: stage.text for stage in found.stages}
    assert texts["publisher"] == "/joy on joystick publishes /stick (/joy/stick over there)"
    assert texts["policy here"] == "this module takes it as /cmd (its /stick)"


def test_a_single_look_is_judged() -> None:
    found = one(replace(Case(), readers_later=None))
    assert found.flows


_names = st.text(max_size=20)
_sources = st.builds(
    PublisherReport,
    node=st.sampled_from(["/joy", "/other"]),
    type=_names,
    crosses=st.booleans(),
    rule=_names,
    offered=st.booleans(),
    route=st.sampled_from(["", "opening", "open", "?"]),
    messages=st.integers(0, 1 << 40),
    dropped=st.integers(0, 1 << 40),
)
_answers = st.none() | st.builds(
    TopicAtPublisher, sources=st.lists(_sources, max_size=3).map(tuple), subscribers=st.tuples(_names), similar=_names
)
_routes: Callable[[], st.SearchStrategy[RouteInfo]] = lambda: st.builds(  # noqa: E731
    lambda **changes: msgspec.structs.replace(ROUTE, **changes),
    state=st.sampled_from(["idle", "opening", "open", "lingering", "waiting", "hidden"]),
    messages=st.integers(0, 1000),
    age=st.none() | st.floats(0, 1e6),
    period=st.none() | st.just(ROUTE.period),
    problem=_names,
)


@given(_answers, _answers, st.none() | _routes(), st.none() | _routes(), st.booleans())
def test_any_answer_of_a_peer_is_judged(
    there: TopicAtPublisher | None,
    later: TopicAtPublisher | None,
    before: RouteInfo | None,
    after: RouteInfo | None,
    known: bool,
) -> None:
    one_, other = Case(there=there, source=None, route=before), Case(there=later, source=None, route=after)
    found = diagnose_topic(
        one_.ends(before, None, one_.readers),
        "joystick",
        other.ends(after, None, one_.readers) if known else None,
    )
    assert found
    for diagnosis in found:
        assert diagnosis.flows is (diagnosis.failed is None)
        for stage in diagnosis.stages[:-1]:
            assert stage.level is not CheckLevel.FAIL
        assert msgspec.convert(msgspec.to_builtins(diagnosis), Diagnosis) == diagnosis


def test_a_stage_is_short_as_json() -> None:
    assert msgspec.to_builtins(Check("peer", CheckLevel.OK, "known")) == {
        "name": "peer",
        "verdict": "ok",
        "text": "known",
    }
