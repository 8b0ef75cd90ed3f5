"""How long a resource takes to decide: merge what all clients ask, and find the most similar profile.

No process, no network: the pure machines, in this process. Every decision is another question: either one client asks
anew, or all of them do at once; all requirements are merged, all profiles judged. *Explain* is each profile's every
term, which is published behind a decision.
"""

from __future__ import annotations

import gc
import random
import time
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final

from lab import samples
from lab.figures import shapes
from lab.findings import Claim
from lab.results import finish
from lab.tables import table_of, us
from rmpa.resource.decide.decision import Decider
from rmpa.resource.declare.attributes import Attribute, Direction, Scale
from rmpa.resource.declare.profiles import Profile
from rmpa.resource.declare.requirements import Bound, Requirement, bound, merge

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from rich.console import Console

    from rmpa.resource.declare.attributes import Value

_SIZES: Final = ((5, 5, 2), (20, 10, 10), (100, 20, 50))
"""Profiles, attributes, clients; the last one is to be reached."""
_LIMIT_MS: Final = 1.0
_WORDS: Final = ("low", "fair", "good", "best")
_SEED: Final = 7
_WARM_UP: Final = 50
_WHOLE: Final = "merge + decide"
_EXPLAIN_EVERY: Final = 10


def measure(quick: bool, console: Console, json: Path | None = None) -> dict[str, object]:
    """Measure, print the table, write the files; return the result."""
    decisions = 1000 if quick else 10_000
    table = table_of(
        f"deciding, µs; {decisions} questions each",
        ("profiles", "attributes", "clients", "who asks anew", "step"),
        ("p50", "p99", "p99.9", "max"),
    )
    rows: list[dict[str, object]] = []
    panels: dict[str, dict[str, list[float]]] = {}
    whole = samples.summary([])
    for size in _SIZES:
        panel = panels.setdefault("{} profiles, {} attributes, {} clients".format(*size), {})
        for who, anew in (("one", 1), ("all", size[2])):
            for step, times in _decide(Model(*size), decisions, anew).items():
                found = samples.summary(times)
                whole = found if step == _WHOLE else whole
                panel[f"{step}, {who} anew"] = times
                table.add_row(*map(str, size), who, step, *map(us, (found.p50, found.p99, found.p999, found.largest)))
                rows.append(
                    {
                        "profiles": size[0],
                        "attributes": size[1],
                        "clients": size[2],
                        "anew": who,
                        "step": step,
                        "us": asdict(found),
                    }
                )
    console.print(table)
    what = "{} profiles x {} attributes x {} clients, all anew, ms".format(*_SIZES[-1])
    targets = [
        Claim(f"{what}, {name}", value / 1000 if value is not None else None, _LIMIT_MS)
        for name, value in (("p50", whole.p50), ("p99", whole.p99))
    ]
    result: dict[str, object] = {"rows": rows}
    return finish(
        console,
        "decision",
        {"decisions": decisions, "seed": _SEED},
        result,
        json,
        claims=targets,
        panels=shapes.tails(panels, "µs", 1000 * _LIMIT_MS),
    )


@dataclass(slots=True)
class Model:
    """A resource that might be: attributes of all kinds, profiles that offer them all, clients that ask for them all.

    Args:
        profiles: How many.
        attributes: How many; one in five has words.
        clients: How many; one in ten of their bounds is hard.
    """

    profiles: int
    attributes: int
    clients: int

    def declared(self) -> dict[str, Attribute]:
        """The attributes, in turn of each direction and scale."""
        kinds = (
            (Direction.MAX, Scale.LOG, ()),
            (Direction.MIN, Scale.LOG, ()),
            (Direction.MIN, Scale.LINEAR, ()),
            (Direction.TARGET, Scale.LINEAR, ()),
            (Direction.MAX, Scale.ORDINAL, _WORDS),
        )
        found = {}
        for number in range(self.attributes):
            direction, scale, words = kinds[number % len(kinds)]
            found[f"quality_{number}"] = Attribute(f"quality_{number}", direction, scale=scale, words=words)
        return found

    def decider(self, attributes: Mapping[str, Attribute], chance: random.Random) -> Decider:
        """The profiles, each with a value of every attribute."""
        profiles = [
            Profile(
                f"profile_{number}",
                {name: _value(attribute, chance) for name, attribute in attributes.items()},
                cost=chance.uniform(0, 10),
                best_effort=number == 0,
            )
            for number in range(self.profiles)
        ]
        return Decider("model", attributes, profiles)

    def requirement(self, client: int, attributes: Mapping[str, Attribute], chance: random.Random) -> Requirement:
        """What one client asks: of every attribute."""
        bounds = {name: _bound(attribute, chance) for name, attribute in attributes.items()}
        return Requirement(f"/client_{client}", bounds, priority=client % 3)


def _value(attribute: Attribute, chance: random.Random) -> Value:
    return chance.choice(attribute.words) if attribute.words else chance.uniform(1, 100)


def _bound(attribute: Attribute, chance: random.Random) -> Bound:
    hard, weight = chance.random() < 0.1, chance.choice((1.0, 1.0, 2.0))
    if attribute.direction is Direction.MIN:
        return bound(attribute, at_most=_value(attribute, chance), hard=hard, weight=weight)
    if attribute.direction is Direction.TARGET:
        low, high = chance.uniform(1, 50), chance.uniform(50, 100)
        return bound(attribute, at_least=low, at_most=high, hard=hard, weight=weight)
    return bound(attribute, at_least=_value(attribute, chance), hard=hard, weight=weight)


def _decide(model: Model, decisions: int, anew: int) -> dict[str, list[float]]:
    """Microseconds of each step of each decision; before each, so many clients ask anew."""
    chance = random.Random(_SEED)
    attributes = model.declared()
    decider = model.decider(attributes, chance)
    asked = {n: model.requirement(n, attributes, chance) for n in range(model.clients)}
    others = [model.requirement(n % model.clients, attributes, chance) for n in range(997)]
    took: dict[str, list[float]] = {"merge": [], "decide": [], _WHOLE: [], "explain": []}
    gc.collect()
    gc.freeze()  # as `rmpa run` does
    for turn in range(_WARM_UP + decisions):
        for number in range(turn * anew, (turn + 1) * anew):
            asked[number % model.clients] = others[number % len(others)]
        begin = time.perf_counter_ns()
        merged = merge(asked.values())
        middle = time.perf_counter_ns()
        decider.decide(merged.bounds)
        end = time.perf_counter_ns()
        if turn < _WARM_UP:
            continue
        took["merge"].append((middle - begin) / 1e3)
        took["decide"].append((end - middle) / 1e3)
        took[_WHOLE].append((end - begin) / 1e3)
        if turn % _EXPLAIN_EVERY == 0:
            bounds = merged.bounds
            took["explain"].append(_us(lambda bounds=bounds: decider.explain(bounds)))  # type: ignore[misc]
    return took


def _us(function: Callable[[], object]) -> float:
    begin = time.perf_counter_ns()
    function()
    return (time.perf_counter_ns() - begin) / 1e3
