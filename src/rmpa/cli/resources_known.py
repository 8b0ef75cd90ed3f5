"""Which resources a module of this machine has seen before, as its ``rmpa run`` wrote them down."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rmpa.bridge.proxy_names import proxied_node
from rmpa.cli.output import duration, printable, warn
from rmpa.cli.resources_seen import SeenResource
from rmpa.resource.run.registry_writer import FILE
from rmpa.resource.run.resource_registry import ResourceRegistry
from rmpa.resource.run.store import read_state
from rmpa.runtime.state_dir import module_dir, state_dir

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path


@dataclass(frozen=True, slots=True)
class KnownResource:
    """One resource.

    Args:
        module: Who has seen it; the names are those of its graph.
        seen: As it was then.
        first: When it was seen first, Unix seconds.
        last: And last.
    """

    module: str
    seen: SeenResource
    first: float
    last: float

    @property
    def ago(self) -> float:
        """Seconds since it was seen last; 0 where the clock was set back meanwhile."""
        return max(0.0, time.time() - self.last)

    def __str__(self) -> str:
        """Where it is now, for a column of states."""
        return f"last seen {duration(self.ago)} ago, not here now"


def remembered(module: str | None, state: str | None, here: Iterable[SeenResource]) -> list[KnownResource]:
    """The resources that were seen before and are not here now, the latest first.

    Args:
        module: Which has seen them; ``None``: any of this machine.
        state: Where they are written down; ``None``: where ``rmpa run`` does so by default.
        here: Those that are here.
    """
    directory = state_dir(os.environ, state)
    if directory is None:
        return []
    paths = [module_dir(directory, module) / FILE] if module is not None else directory.glob(f"*/{FILE}")
    present = {(each.path, each.peer) for each in here}
    found = [
        each for path in sorted(paths) for each in _read(path) if (each.seen.path, each.seen.peer) not in present
    ]
    return sorted(found, key=lambda each: -each.last)


def _read(path: Path) -> list[KnownResource]:
    if not path.exists():
        return []
    try:
        rows = read_state(path)
    except OSError as error:
        warn(printable(str(error)))
        return []
    latest: dict[tuple[str, str | None], KnownResource] = {}
    for each in ResourceRegistry(rows).all:  # the latest first
        proxy = proxied_node(each.caller)
        peer = proxy[0] if proxy is not None else None
        one = KnownResource(
            path.parent.name,
            SeenResource(each.path, peer, each.caller, each.descriptor),
            each.first_ns / 1e9,
            each.last_ns / 1e9,
        )
        latest.setdefault((each.path, peer), one)
    return list(latest.values())
