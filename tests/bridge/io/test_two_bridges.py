"""Whole bridges against each other over links that fall: what must come of it, whatever happens in whatever order."""

from __future__ import annotations

import asyncio
import logging
import random
from collections.abc import Callable, Coroutine
from functools import partial

import pytest

from rmpa.bridge import limits
from rmpa.bridge.messages import OpenRoute, Source, encode
from rmpa.core import limits as core_limits
from rmpa.core.contract import Contract, ContractRule, Durability, Priority, Reliability
from rmpa.mesh import limits as mesh_limits
from rmpa.mesh.frames import Frame, FrameKind
from tests.bridge.io import two_bridges
from tests.bridge.io.nodes import Listener, Speaker
from tests.bridge.io.two_bridges import World
from tests.simulation.scenario import FACTOR

SIZES = (10, 60, 200, 1500)
TOPICS = ("/plain", "/sure", "/kept", "/urgent", "/slow")
RULES = (
    ContractRule(("/sure",), (), {"reliability": Reliability.RELIABLE}),
    ContractRule(("/kept",), (), {"durability": Durability.TRANSIENT_LOCAL, "depth": 3}),
    ContractRule(("/urgent",), (), {"priority": Priority.HIGH, "reliability": Reliability.RELIABLE}),
    ContractRule(("/slow",), (), {"max_rate": 50.0}),
    ContractRule(("/timed",), (), {"deadline": 1.0, "liveliness_lease": 5.0}),
)


play = partial(two_bridges.play, rules=RULES, kept=("/kept",))


def numbers(listener: Listener, speaker: Speaker) -> list[int]:
    """What a listener has heard of a speaker."""
    return [number for _, number in listener.got[speaker.number]]


# --- nothing is lost, nothing comes twice -----------------------------------------------------------------------


async def outages(world: World) -> None:
    """Two reliable topics, while cables are pulled and the bulk lane falls, for less than is waited for."""
    rng, (a, b) = world.rng, world.sides
    speakers = [world.speak(a, "/sure", "/one"), world.speak(a, "/urgent", "/two"), world.speak(b, "/sure", "/three")]
    listeners = [world.listen(side, topic) for side in world.sides for topic in ("/sure", "/urgent")]
    world.link()
    await world.rest(1.0)
    for _ in range(rng.randint(10, 120)):
        match rng.randint(0, 9):
            case 0 | 1 | 2:
                speaker = rng.choice(speakers)
                for _ in range(rng.choice([1, 1, 2, 12])):
                    speaker.say(rng.choice(SIZES))
            case 3 | 4 | 5:
                count = rng.choice([1, 30, 150, 1000, 1 << 20])
                world.carry(rng.randint(0, 1), rng.choice(["express", "bulk"]), count, arrive=rng.random() < 0.8)
            case 6:
                await world.wait(rng.choice([0.0, 0.002, 0.06, 0.3]))
            case 7:
                rng.choice([world.cut_bulk, world.mend_bulk])()
            case 8:
                world.notice_bulk(rng.randint(0, 1))
            case 9:
                await world.outage(rng.choice([0.0, 0.4, 0.6, 1.5, 5.0, core_limits.RESUME_WINDOW * 0.9]))
    world.link()
    await world.rest(8.0)
    for speaker in speakers:
        for listener in listeners:
            if listener.topic == speaker.topic and listener.side is not speaker.side:
                wanted = list(range(1, speaker.said + 1))
                heard = numbers(listener, speaker)
                assert heard == wanted, f"{listener.topic} of {speaker.node}: {heard} of {speaker.said}"
                assert len({ear for ear, _ in listener.got[speaker.number]}) <= 1, "hung up on"


@pytest.mark.parametrize("block", range(3 * FACTOR))
def test_reliable_topics_survive_every_outage_that_is_waited_for(block: int) -> None:
    for seed in range(block * 12, block * 12 + 12):
        play(seed, outages, clocks=bool(seed % 2))


async def a_best_effort_route(world: World) -> None:
    """Its link ends; nobody can say what it misses until the next one, so that it did is what is counted."""
    a, b = world.sides
    speaker = world.speak(a, "/urgent", "/two")
    world.speak(a, "/sure", "/one")
    world.link()
    await world.rest(0.5)
    listener = world.listen(b, "/plain")
    plain = world.speak(a, "/plain", "/three")
    world.listen(b, "/sure")
    await world.rest(1.0)
    for said in (speaker, plain):
        said.say(10)
    await world.rest(0.1)
    assert numbers(listener, plain) == [1]
    assert b.bridge.counters["route.interrupted"] == 0
    await world.outage(0.6)
    assert (a.bridge.counters["route.interrupted"], b.bridge.counters["route.interrupted"]) == (0, 1)


def test_that_a_best_effort_route_was_interrupted_is_counted() -> None:
    play(0, a_best_effort_route, clocks=False)


async def an_owed_acknowledgement(world: World) -> None:
    """The next link stands before an acknowledgement of the last one is due; its numbers mean other routes."""
    a, b = world.sides
    first, second = world.speak(a, "/sure", "/one"), world.speak(a, "/urgent", "/two")
    world.link()
    await world.rest(0.5)
    listeners = [world.listen(b, "/urgent")]
    await world.rest(0.5)
    listeners.append(world.listen(b, "/sure"))
    await world.rest(0.5)
    for _ in range(3):
        second.say(10)
    world.carry(0, "express", 1 << 20)
    world.link()
    for _ in range(20):
        await asyncio.sleep(0.001)
        world.carry(1, "express", 1 << 20)
        if not any(
            a.bridge.topics.exports.senders(one.peer) for one in a.attached
        ):  # the answer to what it asked for takes its time
            world.carry(0, "express", 1 << 20)
    await world.rest(1.0)
    for speaker in (first, second):
        speaker.say(10)
    await world.rest(1.0)
    assert (numbers(listeners[0], second), numbers(listeners[1], first)) == ([1, 2, 3, 4], [1])


def test_an_acknowledgement_that_is_owed_goes_to_nobody_else() -> None:
    for seed in range(10):
        play(seed, an_owed_acknowledgement)


async def a_lie(world: World) -> None:
    """A peer says that it has messages that were never sent."""
    a, b = world.sides
    speaker = world.speak(a, "/sure", "/one")
    listener = world.listen(b, "/sure")
    world.link()
    await world.rest(0.5)
    speaker.say(10)
    await world.rest(0.5)
    world.link()
    end = a.link
    assert end is not None
    epoch = a.bridge.topics.exports.flows[Source("/sure", "/one")].epoch
    lie = OpenRoute(1, "/sure", "/one", Contract(reliability=Reliability.RELIABLE), epoch=epoch, after=99)
    end.receive(Frame(FrameKind.CONTROL, encode(lie)))
    world.link()
    await world.rest(0.5)
    speaker.say(10)
    await world.rest(0.5)
    assert numbers(listener, speaker) == [1, 2]
    world.leave(listener)
    await world.rest(2 * mesh_limits.RESUME_CLAIM, step=0.1)
    world.check_nothing_is_left()


def test_a_position_that_no_message_has_harms_nobody_else() -> None:
    play(0, a_lie)


# --- everything happens -----------------------------------------------------------------------------------------


async def mischief(world: World) -> None:
    """Nodes come, die and restart; listeners come and go; links and lanes fall, some for too long."""
    rng = world.rng
    world.link()
    for _ in range(rng.randint(20, 150)):
        if rng.random() < 0.55:
            something_about_nodes(world, rng)
        else:
            await something_about_links(world, rng)
    await come_to_rest(world)


def something_about_nodes(world: World, rng: random.Random) -> None:
    """One comes, goes, speaks or listens."""
    side, topic, node = rng.choice(world.sides), rng.choice(TOPICS), rng.choice(["/n", "/m"])
    listeners = [listener for one in world.sides for listener in one.listeners]
    speakers = [speaker for one in world.sides for speaker in one.speakers.values()]
    match rng.randint(0, 7):
        case 0:
            world.speak(side, topic, node, latching=rng.random() < 0.3)
        case 1:
            world.hush(side, topic, node)
        case 2 | 3 if len(listeners) < 8:
            world.listen(side, topic)
        case 4 if listeners:
            world.leave(rng.choice(listeners))
        case 5 | 6 | 7 if speakers:
            speaker = rng.choice(speakers)
            for _ in range(rng.choice([1, 2, 12])):
                speaker.say(rng.choice(SIZES))


async def something_about_links(world: World, rng: random.Random) -> None:
    """Bytes leave and arrive, time goes on, a lane or a link falls or is mended."""
    match rng.randint(0, 9):
        case 0 | 1 | 2 | 3:
            for _ in range(4):
                count = rng.choice([1, 100, 1000, 1 << 20])
                world.carry(rng.randint(0, 1), rng.choice(["express", "bulk"]), count, arrive=rng.random() < 0.8)
        case 4 | 5:
            await world.wait(rng.choice([0.0, 0.003, 0.06, 0.7, 6.0]))
        case 6:
            world.cut_bulk()
        case 7:
            world.notice_bulk(rng.randint(0, 1))
        case 8:
            world.mend_bulk()
        case 9 if rng.random() < 0.5:
            await world.outage(rng.choice([0.0, 0.3, 0.7, 4.0, core_limits.RESUME_WINDOW + 2]))


async def come_to_rest(world: World) -> None:
    """In the end all who listen hear all who speak; and when nobody listens nothing is left."""
    world.link()
    await world.rest(12.0)
    speakers = [speaker for side in world.sides for speaker in side.speakers.values()]
    for speaker in speakers:
        speaker.say(world.rng.choice(SIZES))
    await world.rest(2.0)
    for side in world.sides:
        for listener in side.listeners:
            for speaker in speakers:
                if speaker.side is not side and speaker.topic == listener.topic:
                    assert numbers(listener, speaker)[-1:] == [speaker.said], f"{speaker.node} {speaker.topic}"
    for side in world.sides:
        for listener in list(side.listeners):
            world.leave(listener)
    await world.rest(limits.ROUTE_LINGER + core_limits.RESUME_WINDOW + 10.0, step=0.1)
    world.check_nothing_is_left()


@pytest.mark.parametrize("block", range(3 * FACTOR))
def test_whatever_happens_all_is_well_in_the_end(block: int, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.ERROR)
    for seed in range(1020 + block * 10, 1030 + block * 10):
        play(seed, mischief, clocks=bool(seed % 2))
    assert not [record for record in caplog.records if record.levelno >= logging.ERROR]


# --- one source at its proxy --------------------------------------------------------------------------------------


async def timed(world: World) -> Speaker:
    """A source with a deadline and a lease, which one node of the other side listens to and has heard once."""
    a, b = world.sides
    speaker, listener = world.speak(a, "/timed", "/one"), world.listen(b, "/timed")
    world.link()
    await world.rest(1.0)
    speaker.say(10)
    await world.rest(0.5)
    assert numbers(listener, speaker) == [1]
    return speaker


async def a_missed_deadline(world: World) -> None:
    speaker, counters = await timed(world), world.sides[1].bridge.counters
    assert counters["contract.deadline_missed"] == 0
    await world.rest(1.0)
    assert counters["contract.deadline_missed"] == 1, "it is said when it is missed"
    world.leave(world.sides[1].listeners[0])
    await world.rest(limits.ROUTE_LINGER + 1.0)
    missed = counters["contract.deadline_missed"]
    await world.rest(10.0)
    assert counters["contract.deadline_missed"] == missed, "nothing waits for it any more"
    assert speaker.said == 1


async def a_bye(world: World) -> None:
    await timed(world)
    for index in (0, 1):
        world.notice(index, silent=False)
    await asyncio.sleep(0.1)
    assert world.sides[1].bridge.counters["contract.liveliness_lost"] == 1, "at once"
    await asyncio.sleep(60.0)
    assert world.sides[1].bridge.counters["contract.liveliness_lost"] == 1


async def a_silence(world: World) -> None:
    await timed(world)
    for index in (0, 1):
        world.notice(index, silent=True)
    await asyncio.sleep(1.0)
    assert world.sides[1].bridge.counters["contract.liveliness_lost"] == 0
    await asyncio.sleep(60.0)
    assert world.sides[1].bridge.counters["contract.liveliness_lost"] == 1


async def a_late_listener(world: World) -> None:
    """Of what a publisher has said it gets as much as the contract keeps."""
    a, b = world.sides
    speaker, first = world.speak(a, "/kept", "/one"), world.listen(b, "/kept")
    world.link()
    await world.rest(1.0)
    for _ in range(5):
        speaker.say(10)
        await world.rest(0.1)
    assert numbers(first, speaker) == [1, 2, 3, 4, 5]
    late = world.listen(b, "/kept")
    await world.rest(0.5)
    assert numbers(late, speaker) == [3, 4, 5]


async def a_changed_header(world: World) -> None:
    a, b = world.sides
    listener = world.listen(b, "/plain")
    world.link()
    for latching in (False, True):
        speaker = world.speak(a, "/plain", "/one", latching=latching)
        await world.rest(2.0)
        speaker.say(10)
        await world.rest(2.0)
        assert numbers(listener, speaker)[-1:] == [1]
    ears = [listener.got[number][-1][0] for number in (1, 2)]
    assert ears[0] is not ears[1], "its subscribers are to read the new header"


async def a_core_that_forgets(world: World) -> None:
    a, b = world.sides
    world.speak(a, "/plain", "/one")
    world.link()
    await world.rest(1.0)
    there = b.core.publishers("/plain")
    [(node, uri)] = there.items()
    b.core.call("unregisterPublisher", node, "/plain", uri)
    await world.rest(2 * limits.RECONCILE_INTERVAL, step=0.1)
    assert b.core.publishers("/plain") == there


@pytest.mark.parametrize(
    "scene", [a_missed_deadline, a_bye, a_silence, a_late_listener, a_changed_header, a_core_that_forgets]
)
def test_a_source_at_its_proxy(scene: Callable[[World], Coroutine[object, object, None]]) -> None:
    play(1, scene)
