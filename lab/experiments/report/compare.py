"""Two runs side by side: what came out, and what differs in how it was measured."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import msgspec

from lab import words
from lab.experiments.registry import find_experiment
from lab.experiments.report.sections import gather
from lab.experiments.store import Store

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from lab.experiments.model import Experiment
    from lab.findings import Claim

# Facts that differ from one minute to the next, or are said with the code.
_NOT_OF_THE_MACHINE: Final = {"load", "commit", "rmpa"}


@dataclass(frozen=True, slots=True)
class Difference:
    """Something that was not the same.

    Args:
        what: ``plan: link``, ``machine: kernel``, ``control: cells measured``.
        a: In the one run.
        b: In the other.
    """

    what: str
    a: str
    b: str


@dataclass(frozen=True, slots=True)
class ComparedClaim:
    """A figure of both runs.

    Args:
        experiment: Its experiment's name.
        text: What it is.
        unit: Of both.
        a: In the one run; ``None`` where it is not there or the samples were too few.
        b: In the other.
        ratio: b / a.
    """

    experiment: str
    text: str
    unit: str
    a: float | None
    b: float | None
    ratio: float | None


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two runs.

    Args:
        differences: What differs in how they were measured.
        claims: What came out.
    """

    differences: tuple[Difference, ...]
    claims: tuple[ComparedClaim, ...]


def compare(a: Path, b: Path, find: Callable[[str], Experiment] = find_experiment) -> Comparison:
    """Compare two run directories.

    Args:
        a: The one.
        b: The other.
        find: Finds an experiment by name.

    Raises:
        ConfigError: One of them is no run directory.
    """
    stores = Store.load(a), Store.load(b)
    told = [_told(store) for store in stores]
    claims: list[ComparedClaim] = []
    for name in dict.fromkeys([*stores[0].names, *stores[1].names]):
        found: list[dict[str, Claim]] = []
        for store, said in zip(stores, told, strict=True):
            section = gather(store, name, find=find) if name in store.names else None
            found.append({claim.text: claim for claim in section.findings.claims} if section else {})
            said[f"{name}: cells measured"] = str(section.cells) if section else ""
            said[f"{name}: no findings"] = section.problem if section else ""
        claims += [_compared(name, text, *found) for text in dict.fromkeys([*found[0], *found[1]])]
    return Comparison(_differences(*told), tuple(claims))


def _compared(name: str, text: str, first: Mapping[str, Claim], second: Mapping[str, Claim]) -> ComparedClaim:
    unit = (first.get(text) or second[text]).unit
    a, b = (claims[text].value if text in claims else None for claims in (first, second))
    return ComparedClaim(name, text, unit, a, b, b / a if a and b is not None else None)


def _told(store: Store) -> dict[str, str]:
    """All that a run says of how it was made, by a name."""
    manifest = store.manifest
    plan, code = msgspec.to_builtins(manifest.plan), msgspec.to_builtins(manifest.code)
    told = {f"plan: {name}": words.value(value) for name, value in plan.items()}
    told |= {f"code: {name}": words.value(value) for name, value in code.items()}
    machine = {name: value for name, value in manifest.machine.items() if name not in _NOT_OF_THE_MACHINE}
    return told | {f"machine: {name}": words.value(value) for name, value in machine.items()}


def _differences(a: Mapping[str, str], b: Mapping[str, str]) -> tuple[Difference, ...]:
    names = dict.fromkeys([*a, *b])
    return tuple(Difference(name, a.get(name, ""), b.get(name, "")) for name in names if a.get(name) != b.get(name))
