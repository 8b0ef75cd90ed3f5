"""Disturbances of the stage, drawn from a seed: the same seed gives the same ones, though not at the same moments."""

from __future__ import annotations

import signal
import time
from typing import TYPE_CHECKING, Final

from lab.bed.agents import Agent
from tests.soak.stage import LISTENERS, STEADY, TALKERS, Stage

if TYPE_CHECKING:
    import random
    from collections.abc import Callable


Disturbance = tuple[str, "Callable[[], list[str]]"]
"""Its description, and the function that does it and returns what went wrong."""


def draw(rng: random.Random, stage: Stage) -> Disturbance:
    """The next disturbance."""
    kind = rng.choices(list(_KINDS), weights=[weight for weight, _ in _KINDS.values()])[0]
    return _KINDS[kind][1](rng, stage)


def _short_cut(rng: random.Random, stage: Stage) -> Disturbance:
    name, seconds = rng.choice(list(stage.modules)), rng.uniform(0.05, 0.9)
    return f"cable of {name} out for {seconds:.1f} s", lambda: _cut(stage, name, seconds)


def _long_cut(rng: random.Random, stage: Stage) -> Disturbance:
    name, seconds = rng.choice(list(stage.modules)), rng.uniform(1.0, 6.0)
    return f"cable of {name} out for {seconds:.1f} s", lambda: _cut(stage, name, seconds)


def _flapping(rng: random.Random, stage: Stage) -> Disturbance:
    name = rng.choice(list(stage.modules))
    times = [(rng.uniform(0.02, 0.4), rng.uniform(0.02, 0.8)) for _ in range(rng.randint(3, 6))]

    def flap() -> list[str]:
        for out, back in times:
            _cut(stage, name, out)
            time.sleep(back)
        return []

    return f"cable of {name} out {len(times)} times", flap


def _cut(stage: Stage, name: str, seconds: float) -> list[str]:
    stage.modules[name].host.outage(seconds)
    return []


def _hang(rng: random.Random, stage: Stage) -> Disturbance:
    name, seconds = rng.choice(list(stage.modules)), rng.uniform(0.2, 3.0)

    def hang() -> list[str]:
        stage.modules[name].agent.freeze()
        time.sleep(seconds)
        stage.modules[name].agent.thaw()
        return []

    return f"agent {name} hangs for {seconds:.1f} s", hang


def _restart(rng: random.Random, stage: Stage) -> Disturbance:
    name = next(name for name in stage.modules if name not in STEADY)
    number = rng.choice((signal.SIGTERM, signal.SIGKILL))
    end: Callable[[Agent], object] = Agent.terminate if number is signal.SIGTERM else Agent.kill
    return f"agent {name} gets {number.name}", lambda: stage.restart(name, end)


def _talker(rng: random.Random, stage: Stage) -> Disturbance:
    talker = rng.choice(TALKERS)

    def again() -> list[str]:
        stage.restart_talker(talker)
        return []

    return f"{talker} gets SIGKILL", again


def _listener(rng: random.Random, stage: Stage) -> Disturbance:
    listener = rng.choice(LISTENERS)

    def again() -> list[str]:
        problems = stage.kill_listener(listener)
        stage.listen(listener)
        return problems

    return f"{listener} gets SIGKILL", again


def _stuck(rng: random.Random, stage: Stage) -> Disturbance:
    listener, seconds = (
        rng.choice([listener for listener in LISTENERS if not listener.reliable]),
        rng.uniform(1.0, 4.0),
    )

    def stop() -> list[str]:
        stage.listeners[listener].freeze()
        time.sleep(seconds)
        stage.listeners[listener].thaw()
        return []

    return f"{listener} hangs for {seconds:.1f} s", stop


_KINDS: Final[dict[str, tuple[int, Callable[[random.Random, Stage], Disturbance]]]] = {
    "short cut": (4, _short_cut),
    "long cut": (2, _long_cut),
    "flapping": (1, _flapping),
    "hang": (2, _hang),
    "restart": (3, _restart),
    "talker": (2, _talker),
    "listener": (2, _listener),
    "stuck": (1, _stuck),
}
"""By name: relative frequency, and the function that draws the details."""
