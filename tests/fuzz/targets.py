"""Finds the fuzz targets: the rows of both ``readers``, and every ``target_*.py`` with ``fuzz`` and ``SEEDS``."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from tests.fuzz.gateway_readers import GATEWAY_READERS
from tests.fuzz.readers import READERS

_ROWS = READERS | GATEWAY_READERS


class Target(NamedTuple):
    """One parser under attack: ``fuzz`` raises only if it found something."""

    fuzz: Callable[[bytes], None]
    seeds: Sequence[bytes]


def names() -> list[str]:
    """The targets' names, in order."""
    files = (path.stem.removeprefix("target_") for path in Path(__file__).parent.glob("target_*.py"))
    return sorted((*files, *_ROWS))


def load(name: str) -> Target:
    """One target."""
    if (row := _ROWS.get(name)) is not None:
        return Target(row.fuzz, row.seeds)
    module = importlib.import_module(f"tests.fuzz.target_{name}")
    return Target(module.fuzz, module.SEEDS)
