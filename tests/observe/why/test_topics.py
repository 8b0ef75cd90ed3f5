"""``rmpa why``: each stage by itself, from two agents' words that differ in one thing from those of what flows."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.facts import Arrival, FilesInfo, LinkInfo, PublisherReport, RouteInfo, SubscriberTransport
from rmpa.core.statistics import SampleSpread
from rmpa.observe import limits as observe_limits
from rmpa.observe.check import CheckLevel
from rmpa.observe.snapshot import PeerInfo, Snapshot
from rmpa.observe.why.diagnosis import Diagnosis, TopicAtPublisher
from rmpa.observe.why.stages import Ends, diagnose_topic, peer_stages
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
                route=route,
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


def peer(**changes: object) -> PeerInfo:
    return msgspec.structs.replace(PEER, **changes)


def unlinked(state: str, **changes: object) -> PeerInfo:
    return peer(state=state, link=None, **changes)


def silent(seconds: float, **changes: object) -> PeerInfo:
    return peer(link=msgspec.structs.replace(LINK, heard_ago=seconds, **changes))


def source(**changes: object) -> PublisherReport:
    return msgspec.structs.replace(SOURCE, **changes)


def sources(**changes: object) -> dict[str, Any]:
    """The publisher's word at both looks."""
    return {"source": source(**changes), "source_later": source(**changes)}


HERE = SubscriberTransport(node="/base", transport="direct", state="direct", wanted="auto", endpoint="10.0.0.2:41234")
NOTHING_SENT: dict[str, Any] = {"messages": 0, "age": None, "rate": None, "period": None}


def direct(**changes: object) -> Case:
    """``/cmd`` whose only subscriber ``/base`` is direct."""
    here = msgspec.structs.replace(HERE, **changes)
    idle = route(**NOTHING_SENT, state="idle", lane="", md5="", transport="direct", subscribers=(here,))
    return Case(readers=(), readers_later=(), **idle, **sources(route="", messages=0))


def both() -> Case:
    """``/cmd`` with ``/base`` direct, beside ``/rec``, which is relayed."""
    changes: dict[str, Any] = {"transport": "both", "subscribers": (HERE,)}
    readers, subscribers = (connected("/rec"),), ("/base", "/rec")
    first, later = (msgspec.structs.replace(one, **changes) for one in (ROUTE, ROUTE_LATER))
    return Case(route=first, later=later, readers=readers, readers_later=readers, subscribers=subscribers)


def relayed(**changes: object) -> Case:
    """``/cmd`` whose subscriber is relayed for a reason."""
    here = msgspec.structs.replace(HERE, transport="relay", state="relayed", endpoint="", **changes)
    first, later = (
        msgspec.structs.replace(one, transport="relay", subscribers=(here,)) for one in (ROUTE, ROUTE_LATER)
    )
    return Case(route=first, later=later)


def test_a_flowing_topic_passes_all_stages() -> None:
    found = one(Case())
    assert found.flows
    assert found.failed is None
    assert [stage.name for stage in found.stages] == [name for name in ORDER if name not in ONLY_FAILS]
    assert {stage.level for stage in found.stages} == {CheckLevel.OK}
    assert (found.name, found.peer, found.to, found.node) == ("/cmd", "joystick", "base", "/joy")


FAILURES: dict[str, Case] = {
    # What is different; the golden file has the stage that fails, and what is said.
    "unknown peer": Case(peer=None),
    "conflict": Case(peer=peer(state="conflict", conflicts=("shares its address",))),
    "shared address": Case(peer=peer(state="conflict", conflicts=("its address is also b's; give one another",))),
    "unreachable": Case(source=source(offered=False, unreachable="http://nosuch:1/: no such name")),
    "not linked": Case(peer=unlinked("linking", last_error="timed out")),
    "only beacons": Case(peer=unlinked("linking", beacon_ago=1.5)),
    "refused": Case(peer=unlinked("refused", last_error="domain 4 is not 3")),
    "nobody publishes": Case(source=None, route=None),
    "nearly its name": Case(source=None, route=None, there=TopicAtPublisher(similar="/cmd_vel")),
    "only subscribed there": Case(source=None, route=None, there=TopicAtPublisher(subscribers=("/echo",))),
    "an older agent, nothing offered": Case(route=None, there=None, refusal="it does not know the question"),
    "policy there": Case(source=source(crosses=False, rule="bridge.deny has '/cmd'"), route=None),
    "built in": Case(source=source(crosses=False, rule="built in: time does not cross"), route=None),
    "no type": Case(source=source(type="*"), route=None),
    "too many": Case(source=source(offered=False, beyond=70), route=None),
    "too long a name": Case(source=source(offered=False), route=None),
    "no place for its node": Case(
        **route(state="hidden", problem="joystick has more nodes than limits.nodes = 2", limit="nodes")
    ),
    "not told yet": Case(route=None),
    "policy here": Case(**route(state="hidden", problem="bridge.deny has '/cmd'")),
    "type": Case(**route(state="hidden", problem="its type is a/B, but c/D here; rename one"), conflict=True),
    "not registered": Case(registered=False),
    "no descriptor for its proxy": Case(
        registered=False, **route(state="idle", problem="no file descriptor is left for its proxy; raise it")
    ),
    "no descriptor for its subscriber": Case(
        readers=(),
        files=FilesInfo(open=60, limit=64, hard=64, reserved=16, problem="node /x has to wait: none left; raise it"),
        **route(state="idle"),
    ),
    "not connected": Case(readers=(), **route(state="idle")),
    "md5": Case(readers=(), mismatches=("/base: wants 1234",), **route(state="idle")),
    "publisher does not answer": Case(**route(state="opening", md5=""), **sources(route="opening")),
    "peer does not answer": Case(**route(state="opening", md5="")),
    "route closed": Case(**route(state="waiting", md5="", problem="its publisher refuses: no")),
    "nothing published": Case(**route(**NOTHING_SENT), **sources(messages=0)),
    "too long": Case(
        **route(**NOTHING_SENT),
        source=source(messages=0, oversized=4, oversized_bytes=270_000_000),
        source_later=source(messages=0, oversized=5, oversized_bytes=270_000_000),
    ),
    "nothing arrives": Case(**route(**NOTHING_SENT)),
    "nothing arrives any more": Case(later=ROUTE, source_later=source(messages=120, dropped=20)),
    "silent": Case(**route(age=8.0), source_later=SOURCE),
    "readers have left": Case(readers_later=()),
    "whether it is direct is not decided yet": direct(transport="", state="asking", endpoint=""),
    "of another mesh": Case(
        peer=None, stranger=unlinked("foreign", last_error="not of this mesh: it has not joined; let it join")
    ),
    "what a relay brings of other modules": Case(
        peer=unlinked("relayed", via="gate"), known=False, source=None, source_later=None
    ),
    "too many messages for a max_rate": Case(**route(contract={"max_rate": 10.0})),
    "reader stuck": Case(
        readers=(connected("/base", waiting=70_000),), readers_later=(connected("/base", waiting=90_000, dropped=3),)
    ),
}


@pytest.mark.parametrize("case", FAILURES.values(), ids=FAILURES)
def test_the_first_stage_that_fails_is_the_last_one(case: Case) -> None:
    found = one(case)
    assert not found.flows
    assert found.failed is not None
    assert found.failed is found.stages[-1], "nothing behind it is looked at"
    assert found.failed.remedy
    # The stages before it are those of a topic that flows; md5 is only there where something is known of it.
    names = [s.name for s in found.stages]
    assert names == [name for name in ORDER if name in names]
    missing = set(ORDER[: ORDER.index(found.failed.name)]) - set(names)
    assert missing <= {"md5", *ONLY_FAILS}


def test_every_stage_can_fail_but_transport_and_contract() -> None:
    failed = {one(case).stages[-1].name for case in FAILURES.values()}
    assert failed == set(ORDER) - {"contract", "transport"}


WARNINGS: dict[str, Case] = {
    "a link that is silent": Case(peer=silent(0.8)),
    "a link at rest that is silent": Case(peer=silent(8.2, rests=True)),
    "one was refused": Case(mismatches=("/old: wants 1234",)),
    "dropped there": Case(source_later=source(messages=120, dropped=2)),
    "some too long": Case(source_later=source(messages=120, oversized=1, oversized_bytes=270_000_000)),
    "given up": Case(source_later=source(messages=120, lost=7046)),
    "few messages": Case(**route(messages=1, age=30.0, rate=None, period=None), source_later=SOURCE),
    "contract": Case(later=msgspec.structs.replace(ROUTE, messages=120, lost=3, events={"deadline_missed": 2})),
    "one reader of two is stuck": Case(
        readers=(connected("/base"), connected("/slow", waiting=1)),
        readers_later=(connected("/base"), connected("/slow", waiting=1)),
    ),
    "a reader was slow": Case(readers_later=(connected("/base", dropped=9),)),
}


FLOWING: dict[str, Case] = {
    "a topic": Case(),
    "no node subscribes": Case(subscribers=(), readers=(), **route(state="idle")),
    "two modules of one name": Case(peer=peer(conflicts=("two modules are named joystick; rename one",))),
    "bytes that wait once": Case(readers_later=(connected("/base", waiting=70_000),)),
    "an agent that does not answer": Case(there=None, refusal="it is older"),
    "a latched topic of one old message": Case(
        **route(messages=1, age=3600.0, rate=None, period=None, latched=True), source_later=SOURCE
    ),
    "a message on its way": Case(later=ROUTE, source_later=source(messages=101)),
    "a topic that is thinned out": Case(**route(contract={"max_rate": 0.5})),
    "a relayed module": Case(peer=unlinked("relayed", via="gate")),
    "another name at the peer": Case(**route(wire="/stick"), **sources(topic="/joy/stick"), wire="/stick"),
    "a single look": Case(readers_later=None),
    "direct": direct(),
    "direct and relayed": both(),
    "direct, without the peer's agent": replace(direct(), peer=unlinked("linking", last_error="connection reset")),
    "direct, and it cannot be moved": direct(state="relayed", condition="name", text="other name"),
    "relayed by a condition": relayed(condition="caller_id", text="taken"),
    "relayed although direct is wanted": relayed(condition="caller_id", text="taken", wanted="direct"),
    "relayed by a rule": relayed(condition="transport", text='it is "relay"', wanted="direct"),
}


def test_each_publisher_has_its_diagnosis() -> None:
    second = source(node="/second", crosses=False, rule="no")
    there = TopicAtPublisher(sources=(SOURCE, second))
    first, other = Case(there=there, source=None, source_later=None).walk()
    assert (first.node, first.flows) == ("/joy", True)
    assert (other.node, other.flows) == ("/second", False)
    assert other.failed is not None
    assert other.failed.name == "policy there"


def test_the_number_of_diagnoses_is_bounded() -> None:
    many = tuple(source(node=f"/n{i}") for i in range(10 * observe_limits.WHY_SOURCES_MAX))
    found = Case(there=TopicAtPublisher(sources=many), source=None, source_later=None).walk()
    assert len(found) == observe_limits.WHY_SOURCES_MAX


def test_a_peer_is_found_by_guid_and_a_typo_gets_a_hint() -> None:
    assert one(Case(), "10.0.0.2:40002").flows
    assert one(Case(), "10.0.0.2:40002#1").peer == "joystick"
    found = one(Case(), "joystik")
    assert found.failed is not None
    assert found.failed.remedy.startswith("did you mean joystick?")


def test_a_module_behind_a_relay_that_is_gone_is_missed_with_the_relay() -> None:
    (found, *_) = peer_stages(msgspec.structs.replace(SNAPSHOT, peers=(), lost={"pad": "base"}), "pad")
    assert found.text == "pad was reached by way of base, which does not pass on what it publishes any more"
    assert found.remedy.startswith("start base again")


def test_a_relay_that_is_away_is_what_fails() -> None:
    behind, relay = peer(name="pad", state="relayed", via="base", link=None), unlinked("waiting", name="base")
    known = msgspec.structs.replace(SNAPSHOT, peers=(behind, relay))
    *_, link = peer_stages(known, "pad")
    assert link.level is CheckLevel.FAIL
    assert link.text == "no link of its own, and base, which passes on what it publishes, is away"


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
        one_.ends(before, None, one_.readers), "joystick", other.ends(after, None, one_.readers) if known else None
    )
    assert found
    for diagnosis in found:
        assert diagnosis.flows is (diagnosis.failed is None)
        for stage in diagnosis.stages[:-1]:
            assert stage.level is not CheckLevel.FAIL
        assert msgspec.convert(msgspec.to_builtins(diagnosis), Diagnosis) == diagnosis
