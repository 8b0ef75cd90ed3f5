"""The details of topics and services that the usual snapshot of a large graph leaves out."""

from __future__ import annotations

import asyncio
import itertools
from typing import TYPE_CHECKING, Any, ClassVar, cast

import msgspec

from rmpa.web import limits
from rmpa.web.monitor.io.mesh_feed import MeshFeed
from rmpa.web.monitor.view import service_key
from rmpa.web.server.agent_watch import AgentWatch, Reading
from tests.web.snapshots import FULL, peer

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rmpa.observe.peer_info import PeerInfo
    from rmpa.observe.snapshot import Snapshot
    from rmpa.web.monitor.io.resource_watch import ResourceWatch
    from rmpa.web.monitor.patch import Tree

PART = msgspec.structs.replace(
    FULL, topics=(), services=(), topics_left=len(FULL.topics), services_left=len(FULL.services)
)
TOPIC, SERVICE = FULL.topics[0], FULL.services[0]


class Resources:
    """There are no Smart Resources; ``history`` has what was recorded of links."""

    facts: ClassVar[dict[str, Any]] = {}
    recorded = 0

    def __init__(self) -> None:
        self.history: list[str] = []

    def record(self, _level: str, text: str, _at: float, **_whose: str) -> None:
        self.history.append(text)

    def alarms(self) -> tuple[Tree, ...]:
        return ()

    def show_all(self, *, wanted: bool) -> None: ...


class Feed:
    """A feed of an agent that leaves everything out of its usual snapshot, with one page."""

    def __init__(self, usual: Snapshot = PART) -> None:
        self.now = 0.0
        self.asked: list[tuple[Sequence[str], Sequence[str]]] = []
        self.shown = asyncio.Event()
        self.usual = usual
        self.watch = AgentWatch(lambda: self.usual, read_named=self._named)
        self.resources = Resources()
        self.feed = MeshFeed(
            self.watch, cast("ResourceWatch", self.resources), lambda _: None, clock=lambda: self.now
        )
        self.feed._left_out._clock = lambda: self.now

    def _named(self, topics: Sequence[str], services: Sequence[str]) -> Snapshot:
        self.asked.append((topics, services))
        return msgspec.structs.replace(
            FULL,
            topics=tuple(each for each in FULL.topics if each.name in topics),
            services=tuple(each for each in FULL.services if each.name in services),
            peers=(),
        )

    async def start(self) -> Tree:
        """The first state."""
        states: list[Tree] = []

        def show(state: Tree) -> None:
            states.append(state)
            self.shown.set()

        await self.feed.first()
        self.feed.follow(self, show)
        self.shown.clear()
        return states[0]

    async def answered(self) -> None:
        """Wait until pages are shown what the agent was asked for."""
        async with asyncio.timeout(30):
            await self.shown.wait()
        self.shown.clear()

    async def close(self) -> None:
        await self.feed.close()
        await self.watch.close()


async def test_the_page_of_a_topic_that_is_left_out_has_its_details() -> None:
    feed = Feed()
    state = await feed.start()
    assert state["topics"] == {}
    assert state["hidden"] == {"topics": len(FULL.topics), "services": len(FULL.services)}
    assert feed.feed.details("topic", TOPIC.name) is None
    await feed.answered()
    found = feed.feed.details("topic", TOPIC.name)
    assert found is not None
    entry = found["entry"]
    assert isinstance(entry, dict)
    assert (found["name"], entry["type"], entry["from"]) == (TOPIC.name, TOPIC.type, ["arm"])
    assert feed.asked == [([TOPIC.name], [])]
    await feed.close()


async def test_so_has_the_page_of_a_service() -> None:
    feed = Feed()
    await feed.start()
    assert feed.feed.details("service", service_key(SERVICE)) is None
    await feed.answered()
    found = feed.feed.details("service", service_key(SERVICE))
    assert found is not None
    assert cast("Tree", found["entry"])["name"] == SERVICE.name
    assert feed.asked == [([], [SERVICE.name])]
    await feed.close()


async def test_the_agent_is_asked_again_only_while_a_page_looks() -> None:
    feed = Feed()
    await feed.start()
    for _ in range(3):
        assert feed.feed.details("topic", TOPIC.name) is None
    assert feed.feed.details("topic", "/none") is None
    await feed.answered()
    for _ in range(3):
        assert feed.feed.details("topic", "/none") is None
        assert feed.feed.details("topic", TOPIC.name) is not None
    assert feed.asked == [(sorted([TOPIC.name, "/none"]), [])]
    feed.now += limits.WEB_WHOLE_AGE
    assert feed.feed.details("topic", TOPIC.name) is not None
    await feed.answered()
    assert len(feed.asked) == 2
    await feed.close()


async def test_a_snapshot_with_everything_needs_no_further_question() -> None:
    feed = Feed(FULL)
    await feed.start()
    assert feed.feed.details("topic", "/none") is None
    found = feed.feed.details("topic", TOPIC.name)
    assert found is not None
    assert "entry" not in found
    assert feed.asked == []
    await feed.close()


async def test_a_new_start_of_the_own_agent_is_no_loss_and_a_module_that_stays_away_is_one() -> None:
    feed = Feed(FULL)
    numbers = itertools.count(1)

    def read(now: float, uptime: float, *peers: PeerInfo) -> list[str]:
        feed.now = now
        agent = msgspec.structs.replace(FULL.agent, uptime=uptime)
        snapshot = msgspec.structs.replace(FULL, agent=agent, taken=FULL.taken + now, peers=peers)
        feed.feed._take(Reading(next(numbers), 0.0, snapshot))
        feed.resources.history, told = [], feed.resources.history
        return told

    arm, hand = peer("arm"), peer("hand")
    assert read(0.0, 100.0, arm, hand) == read(1.0, 101.0) == []  # it ends, and loses its links first
    feed.feed._take(Reading(next(numbers), 0.0, None, "no agent answers; start one"))
    assert read(3.0, 1.0) == read(4.0, 2.0, peer("arm", state="linking", link=None)) == read(5.0, 3.0, arm) == []
    assert read(62.0, 60.0, arm) == []
    assert read(64.0, 62.0, arm) == ["hand: is away: has left the roster: no beacon and no link"]
    assert read(65.0, 63.0, arm, hand) == ["hand: linked"]
    assert read(66.0, 64.0, arm) == read(67.0, 65.0, arm, hand) == []  # gone for less than the time that counts
    await feed.close()
