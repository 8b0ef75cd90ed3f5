"""Permissions that change while data flows between two bridges over links that fall: who may not, hears nothing."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from rmpa.config.peer_rules import PermissionRule
from rmpa.config.settings import Settings, TrustSettings
from rmpa.core import limits as core_limits
from rmpa.core.contract import ContractRule, Priority, Reliability
from rmpa.trust.permissions import Permissions
from tests.bridge.io.nodes import Listener, Speaker
from tests.bridge.io.two_bridges import Side, World, play
from tests.simulation.scenario import FACTOR

TOPICS = ("/plain", "/sure", "/urgent")
RULES = (
    ContractRule(("/sure",), (), {"reliability": Reliability.RELIABLE}),
    ContractRule(("/urgent",), (), {"priority": Priority.HIGH, "reliability": Reliability.RELIABLE}),
)


@dataclass
class Permitted:
    """What each side lets the other have and bring now, and which messages must not be heard."""

    world: World
    subscribe: dict[int, frozenset[str]] = field(default_factory=dict)
    publish: dict[int, frozenset[str]] = field(default_factory=dict)
    forbidden: dict[int, set[int]] = field(default_factory=dict)
    """By speaker: numbers of messages that were said while the other side was not permitted to have them."""

    def permit(self, side: Side, subscribe: frozenset[str], publish: frozenset[str]) -> None:
        """Read the settings of a side again."""
        number = self.world.sides.index(side)
        self.subscribe[number], self.publish[number] = subscribe, publish
        names = {"subscribe": tuple(sorted(subscribe)), "publish": tuple(sorted(publish))}
        rules = tuple(PermissionRule(("*",), names={key: globs}) for key, globs in names.items() if globs)
        trust = TrustSettings(rules=rules)
        if side.bridge.gate.permissions is None:
            side.bridge.gate.permissions = Permissions(trust)
        side.bridge.reload(Settings(name=side.name, contracts=RULES, trust=trust))

    def say(self, speaker: Speaker, count: int, size: int) -> None:
        """Publish some messages; whoever may not have them now shall never hear them."""
        here = self.world.sides.index(speaker.side)
        for _ in range(count):
            speaker.say(size)
            if speaker.topic not in self.subscribe[here]:
                self.forbidden.setdefault(speaker.number, set()).add(speaker.said)


async def scene(world: World) -> None:
    """Both sides publish all topics, and change what they permit."""
    rng = world.rng
    permitted = Permitted(world)
    everything = frozenset(TOPICS)
    for side in world.sides:
        permitted.permit(side, everything, everything)
    speakers = [world.speak(side, topic, f"/n{topic}") for side in world.sides for topic in TOPICS]
    listeners = [world.listen(side, topic) for side in world.sides for topic in TOPICS]
    world.link()
    await world.rest(1.0)
    for _ in range(rng.randint(10, 60)):
        match rng.randint(0, 6):
            case 0 | 1 | 2:
                permitted.say(rng.choice(speakers), rng.choice([1, 3, 12]), rng.choice([10, 200, 1500]))
            case 3 | 4:
                some = [frozenset(topic for topic in TOPICS if rng.random() < 0.6) for _ in range(2)]
                permitted.permit(rng.choice(world.sides), some[0], some[1])
            case 5:
                await world.rest(rng.choice([0.01, 0.3, 2.0]))
            case 6:
                await world.outage(rng.choice([0.0, 0.6, 5.0, core_limits.RESUME_WINDOW * 0.9]))
    world.link()
    await world.rest(8.0)
    check_shown(permitted)
    for side in world.sides:
        permitted.permit(side, everything, everything)
    await world.rest(20.0)
    for speaker in speakers:
        permitted.say(speaker, 1, 10)
    await world.rest(2.0)
    for speaker in speakers:
        for listener in listeners:
            if listener.topic == speaker.topic and listener.side is not speaker.side:
                check_heard(permitted, speaker, listener)


def check_shown(permitted: Permitted) -> None:
    """Exactly what both sides permit is in the graph."""
    for here, side in enumerate(permitted.world.sides):
        expected = {t for t in TOPICS if t in permitted.publish[here] and t in permitted.subscribe[1 - here]}
        assert {entry.name for entry in side.bridge.topics.imports if entry.shown} == expected


def check_heard(permitted: Permitted, speaker: Speaker, listener: Listener) -> None:
    """Nothing that was forbidden, and again what is permitted again."""
    heard = {number for _, number in listener.got[speaker.number]}
    assert not heard & permitted.forbidden.get(speaker.number, set()), f"{speaker.topic} of {speaker.node}"
    assert speaker.said in heard, f"{speaker.topic} of {speaker.node} is permitted again"


@pytest.mark.parametrize("seed", range(8 * FACTOR))
def test_nothing_is_heard_that_was_said_while_it_was_forbidden(seed: int) -> None:
    play(seed, scene, RULES)
