"""Reliable topics over outages: within the contract's outage each message is delivered, or counted at both ends."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine

import pytest

from rmpa.bridge import limits
from rmpa.bridge.data.quality import QosEventKind
from rmpa.bridge.data.route_sender import ReliableRouteSender
from rmpa.bridge.messages import Source, TopicOffer
from rmpa.core.contract import ContractRule, History, Reliability
from rmpa.mesh import limits as mesh_limits
from tests.bridge.io import two_bridges
from tests.bridge.io.nodes import Listener, Speaker
from tests.bridge.io.two_bridges import Side, World
from tests.simulation.scenario import FACTOR

SURE = Source("/sure", "/one")
PERIOD = 0.05


def play(seed: int, scene: Callable[[World], Coroutine[object, object, None]], **values: object) -> None:
    """Play one scene of a world whose topic /sure is reliable."""
    two_bridges.play(seed, scene, [ContractRule(("/sure",), (), {"reliability": Reliability.RELIABLE, **values})])


def lost_at_receiver(side: Side) -> int:
    """What the receiving module says is lost."""
    (attached,) = side.attached
    entry = side.bridge.topics.imports.get(attached.peer, SURE)
    past = side.bridge.topics.pasts(attached.name).get(SURE)
    watch = side.bridge.topics.watch(entry) if entry is not None else past[0] if past is not None else None
    return watch.counts[QosEventKind.MESSAGES_LOST] if watch is not None else 0


def unknown_at_receiver(side: Side) -> int:
    """How often it says that nobody knows how many."""
    (attached,) = side.attached
    entry = side.bridge.topics.imports.get(attached.peer, SURE)
    flow = entry.flow if entry is not None else None
    return flow.watch.counts[QosEventKind.LOSS_UNKNOWN] if flow is not None else 0


def lost_at_sender(side: Side) -> int:
    """What the sending module says is lost to its peer."""
    (attached,) = side.attached
    route = side.bridge.topics.exports.routes(SURE).get(attached.peer)
    return route.sender.lost if route is not None and route.sender is not None else 0


async def talk(world: World, speaker: Speaker, seconds: float, *, linked: bool = True) -> None:
    """Publish at an even rate for some time."""
    for _ in range(round(seconds / PERIOD)):
        speaker.say(10)
        await world.rest(PERIOD, step=PERIOD) if linked else await asyncio.sleep(PERIOD)


async def begin(world: World) -> tuple[Speaker, Listener]:
    """Both ends, and the first messages."""
    a, b = world.sides
    speaker, listener = world.speak(a, "/sure", "/one"), world.listen(b, "/sure")
    world.link()
    await world.rest(1.0)
    await talk(world, speaker, 0.5)
    return speaker, listener


def told(side: Side) -> list[TopicOffer]:
    """What the other side was told since its link is up."""
    (attached,) = side.attached
    exports = side.bridge.topics.exports
    return [offer for source in exports.offered if (offer := exports.offer(attached.peer, source)) is not None]


async def settled(world: World) -> None:
    """Let all come that is kept: a few messages for each acknowledgement."""
    await world.rest(5.0)
    for side in world.sides:
        exports = side.bridge.topics.exports
        while any(
            isinstance(sender, ReliableRouteSender) and sender.sender.pending
            for attached in side.attached
            for sender in exports.senders(attached.peer)
        ):
            await world.rest(1.0)


def fall_silent(world: World) -> None:
    """The cable is out, and both sides have noticed."""
    world.cut()
    for index in (0, 1):
        world.notice(index, silent=True)


async def resume(world: World, speaker: Speaker) -> None:
    """A new link; all that is kept comes, and what is published then."""
    world.link()
    await settled(world)
    await talk(world, speaker, 1.0)
    await settled(world)


async def outage(world: World, speaker: Speaker, seconds: float) -> None:
    """The cable is out, the publisher goes on; each side notices by its lease, or a little before."""
    world.cut()
    noticed = [min(seconds / 2, mesh_limits.EXPRESS_LEASE * world.rng.uniform(0.3, 1.0)) for _ in world.sides]
    for index, when in enumerate(noticed):
        silent = world.rng.random() < 0.7
        asyncio.get_running_loop().call_later(when, lambda i=index, s=silent: world.notice(i, silent=s))  # type: ignore[misc] # bound here
    await talk(world, speaker, seconds, linked=False)
    world.link()


def accounted(world: World, speaker: Speaker, listener: Listener) -> int:
    """Each message has come, in order and once, or is counted as lost at both ends; return how many were lost."""
    a, b = world.sides
    heard = [number for _, number in listener.got[speaker.number]]
    assert heard == sorted(set(heard)), "doubled or out of order"
    missing = speaker.said - len(heard)
    assert lost_at_receiver(b) == missing, f"{missing} of {speaker.said} did not come"
    assert lost_at_sender(a) == missing
    assert unknown_at_receiver(b) == 0
    return missing


# --- one outage ---------------------------------------------------------------------------------------------


async def one_outage(world: World, seconds: float) -> int:
    speaker, listener = await begin(world)
    await outage(world, speaker, seconds)
    await settled(world)
    await talk(world, speaker, 1.0)
    await settled(world)
    return accounted(world, speaker, listener)


@pytest.mark.parametrize(("window", "seconds"), [(2.0, 35.0), (30.0, 35.0), (5.0, 600.0)])
def test_beyond_it_all_that_was_kept_is_lost_and_the_receiver_says_so(window: float, seconds: float) -> None:
    async def scene(world: World) -> None:
        a, b = world.sides
        speaker, listener = await begin(world)
        fall_silent(world)
        await talk(world, speaker, seconds, linked=False)
        assert not speaker.connections, "nothing is kept any more"
        assert a.bridge.counters["message.given_up"] >= window / PERIOD
        await resume(world, speaker)
        assert unknown_at_receiver(b) == 1
        assert (lost_at_receiver(b), lost_at_sender(a)) == (0, 0)
        assert len(listener.got[speaker.number]) >= 1.0 / PERIOD

    play(2, scene, outage=window, depth=100_000)


@pytest.mark.parametrize("seconds", [20.0, 100.0])
def test_beyond_the_depth_the_oldest_are_lost_and_counted(seconds: float) -> None:
    async def scene(world: World) -> None:
        lost = await one_outage(world, seconds)
        assert round(seconds / PERIOD) - 105 <= lost <= round(seconds / PERIOD) - 75

    play(3, scene, outage=600.0, depth=100)


def test_beyond_the_bytes_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mesh_limits, "REPLAY_BYTES", 50 * 14)

    async def scene(world: World) -> None:
        assert 20 / PERIOD - 55 <= await one_outage(world, 20.0) <= 20 / PERIOD - 25

    play(4, scene, outage=600.0, history=History.KEEP_ALL)


@pytest.mark.parametrize("block", range(3 * FACTOR))
def test_many_outages_within_the_window(block: int) -> None:
    async def scene(world: World) -> None:
        speaker, listener = await begin(world)
        for _ in range(world.rng.randint(1, 4)):
            await outage(world, speaker, world.rng.uniform(1.0, 0.8 * window))
            await world.rest(world.rng.choice([0.3, 3.0, 30.0]))
            await talk(world, speaker, world.rng.choice([0.0, 0.1, 2.0]))
        await settled(world)
        await talk(world, speaker, 1.0)
        await settled(world)
        accounted(world, speaker, listener)

    for seed in range(block * 4, block * 4 + 4):
        window = (5.0, 30.0, 120.0)[seed % 3]
        play(seed, scene, outage=window, depth=(20, 1000, 100_000, 50)[seed % 4])


# --- agents that end meanwhile --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("whose", "window", "seconds", "early"),
    [(1, 30.0, 10.0, 0.1), (1, 30.0, 10.0, 0.9), (1, 2.0, 10.0, 0.9), (0, 30.0, 10.0, 0.5), (0, 30.0, 60.0, 0.5)],
)
def test_an_agent_that_is_restarted_meanwhile_makes_the_loss_unknown(
    whose: int, window: float, seconds: float, early: float
) -> None:
    async def scene(world: World) -> None:
        speaker, _ = await begin(world)
        fall_silent(world)
        await talk(world, speaker, seconds * early, linked=False)
        await world.restart(world.sides[whose])
        await talk(world, speaker, seconds * (1 - early), linked=False)
        await resume(world, speaker)
        a, b = world.sides
        assert unknown_at_receiver(b) == 1
        assert lost_at_receiver(b) == 0
        assert whose == 0 or lost_at_sender(a) == 0

    play(7, scene, outage=window, depth=100_000)


# --- who does not listen any more misses nothing ----------------------------------------------------------------


def test_a_subscriber_that_left_meanwhile_misses_nothing() -> None:
    async def scene(world: World) -> None:
        b = world.sides[1]
        speaker, listener = await begin(world)
        fall_silent(world)
        await talk(world, speaker, 60.0, linked=False)
        world.leave(listener)
        await talk(world, speaker, 2 * limits.RECONCILE_INTERVAL, linked=False)
        late = world.listen(b, "/sure")
        await resume(world, speaker)
        assert len(late.got[speaker.number]) == round(1.0 / PERIOD)
        assert lost_at_receiver(b) == 0
        assert unknown_at_receiver(b) == 0
        world.leave(late)
        await world.rest(2 * mesh_limits.RESUME_CLAIM, step=0.1)
        world.check_nothing_is_left()

    play(9, scene, outage=5.0)


def test_of_a_publisher_that_is_restarted_during_an_outage_messages_may_be_lost() -> None:
    async def scene(world: World) -> None:
        a, b = world.sides
        speaker, listener = await begin(world)
        fall_silent(world)
        await talk(world, speaker, 3.0, linked=False)
        again = world.speak(a, "/sure", "/one")
        await asyncio.sleep(1.0)
        world.link()
        await world.rest(5.0)
        await talk(world, again, 1.0)
        await world.rest(1.0)
        assert speaker.said > len(listener.got[speaker.number])
        assert (lost_at_receiver(b), unknown_at_receiver(b)) == (0, 1)
        assert len(listener.got[again.number]) == again.said

    play(11, scene, outage=30.0)
