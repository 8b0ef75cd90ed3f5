"""What a publisher says to each new subscriber alone, and what all get, at two bridges."""

from __future__ import annotations

import asyncio

import pytest

from rmpa.bridge import limits
from rmpa.mesh import limits as mesh_limits
from tests.bridge.io.nodes import Listener, Speaker
from tests.bridge.io.test_two_bridges import numbers, play
from tests.bridge.io.two_bridges import World
from tests.simulation.scenario import FACTOR

SEEDS = range(2, 2 + 4 * FACTOR)
BIG = 3000


def greets(world: World, topic: str, size: int, *, latching: bool = False) -> tuple[Speaker, Speaker]:
    """A publisher of module a that says one thing of this size to each new connection alone, and as which it does."""
    a, _ = world.sides
    speaker = world.speak(a, topic, "/mapper", latching=latching)
    number = len(world.speakers) + 1
    speaker.greeting = size
    speaker.greets = world.speakers[number] = Speaker(a, number, topic, "/mapper", False)
    return speaker, speaker.greets


async def said(world: World, speaker: Speaker, count: int) -> None:
    for _ in range(count):
        speaker.say(world.rng.choice([10, 10, 1000, BIG]))
        await world.rest(world.rng.choice([0.0, 0.01, 0.1]))


def judge(listeners: list[Listener], speaker: Speaker, greeter: Speaker) -> None:
    """Each subscriber has one greeting, and all messages from its first one on, once and in order."""
    for listener in listeners:
        assert len(numbers(listener, greeter)) == 1  # the same one for those that wait for the publisher's header
        heard = numbers(listener, speaker)
        assert heard == list(range(heard[0], speaker.said + 1))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("topic", ["/plain", "/sure"])
@pytest.mark.parametrize("size", [10, BIG])
def test_each_subscriber_of_a_module_is_a_new_connection(seed: int, topic: str, size: int) -> None:
    async def scene(world: World) -> None:
        speaker, greeter = greets(world, topic, size)
        world.link()
        await world.rest(0.2)
        listeners = []
        for _ in range(4):
            listeners.append(world.listen(world.sides[1], topic))
            if len(listeners) == 1:
                await world.rest(1.0)  # what is said to the first one goes to those that join while it is on its way
            await said(world, speaker, world.rng.randint(1, 12))
        await world.rest(limits.JOIN_WINDOW + 3.0)
        await said(world, speaker, 3)
        await world.rest(3.0)
        judge(listeners, speaker, greeter)
        [session] = world.sides[0].attached
        flows = world.sides[0].bridge.topics.exports.flows.values()
        assert not any(route.joins for flow in flows for route in flow.routes.values()), "the connections have ended"
        assert len(speaker.connections) == 1
        assert len(world.sides[1].link.routes) == 2, "the topic's, and that of questions"  # type: ignore[union-attr]
        assert session.linked

    play(seed, scene)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_join_ends_with_its_link_and_nothing_is_held(seed: int) -> None:
    async def scene(world: World) -> None:
        speaker, _ = greets(world, "/plain", 10)
        world.link()
        await world.rest(0.2)
        listeners = [world.listen(world.sides[1], "/plain")]
        await said(world, speaker, 3)
        listeners.append(world.listen(world.sides[1], "/plain"))
        await said(world, speaker, world.rng.randint(0, 3))
        world.cut()
        speaker.say(10)
        world.link()
        await world.rest(1.0)
        speaker.say(10)
        await world.rest(1.0)
        assert [numbers(listener, speaker)[-1] for listener in listeners] == [speaker.said] * 2

    play(seed, scene)


# --- best effort over a silent link ---------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", SEEDS)
def test_best_effort_survives_a_cut_that_is_shorter_than_the_grace(seed: int) -> None:
    async def scene(world: World) -> None:
        a, b = world.sides
        speaker, listener = world.speak(a, "/plain", "/one"), world.listen(b, "/plain")
        world.link()
        await world.rest(0.5)
        for _ in range(6):
            for _ in range(world.rng.randint(0, 5)):
                speaker.say(world.rng.choice([10, 100]))
                await world.rest(0.01)
            world.cut()
            for _ in range(world.rng.randint(0, 5)):
                speaker.say(world.rng.choice([10, 100]))
            for index in world.rng.sample((0, 1), world.rng.randint(0, 2)):
                world.notice(index, silent=True)
            world.link()
            await world.rest(world.rng.choice([0.0, 0.5]))
        await world.rest(3.0)
        assert numbers(listener, speaker) == list(range(1, speaker.said + 1))
        [session] = b.attached
        flow = next(iter(b.bridge.topics.imports.flows(session.peer)))
        assert not flow.counts, "nothing is lost, late or stale"
        assert flow.quality.messages == speaker.said, "the count goes on"

    play(seed, scene)


@pytest.mark.parametrize("seed", SEEDS)
def test_what_the_queue_does_not_hold_is_told_exactly(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mesh_limits, "ROUTE_QUEUE_BYTES", 3000)

    async def scene(world: World) -> None:
        a, b = world.sides
        speaker, listener = world.speak(a, "/plain", "/one"), world.listen(b, "/plain")
        world.link()
        await world.rest(0.5)
        speaker.say(1000)
        await world.rest(0.5)
        world.cut()
        for _ in range(10):
            speaker.say(1000)
        world.link()
        await world.rest(2.0)
        speaker.say(10)
        await world.rest(1.0)
        heard = numbers(listener, speaker)
        assert heard[-2:] == [speaker.said - 1, speaker.said]
        [session] = b.attached
        flow = next(iter(b.bridge.topics.imports.flows(session.peer)))
        assert flow.counts["lost"] == speaker.said - len(heard) > 0

    play(seed, scene)


# --- the end of a publisher -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("topic", ["/plain", "/sure", "/urgent"])
def test_all_that_a_publisher_said_before_its_end_arrives(seed: int, topic: str) -> None:
    async def scene(world: World) -> None:
        a, b = world.sides
        speaker, listener = world.speak(a, topic, "/one"), world.listen(b, topic)
        world.link()
        await world.rest(0.5)
        for _ in range(20):
            speaker.say(world.rng.choice([10, 20_000]))
        await asyncio.sleep(0.9)  # read here, and not sent yet
        world.hush(a, topic, "/one")
        await world.rest(5.0)
        assert numbers(listener, speaker) == list(range(1, 21))
        assert not a.bridge.topics.exports.flows
        assert not list(b.publications(topic))

    play(seed, scene)
