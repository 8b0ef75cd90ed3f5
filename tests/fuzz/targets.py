"""Finds the fuzz targets: every ``tests/fuzz/target_*.py`` with ``fuzz(data)`` and ``SEEDS``."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence


@dataclass(frozen=True, slots=True)
class Target:
    """One parser under attack: ``fuzz`` raises only if it found something."""

    name: str
    fuzz: Callable[[bytes], None]
    seeds: Sequence[bytes]


def names() -> list[str]:
    """The targets' names, in order."""
    return sorted(path.stem.removeprefix("target_") for path in Path(__file__).parent.glob("target_*.py"))


def load(name: str) -> Target:
    """Import one target."""
    module = importlib.import_module(f"tests.fuzz.target_{name}")
    return Target(name, module.fuzz, module.SEEDS)
