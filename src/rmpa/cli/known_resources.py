"""The resources that modules of this machine have seen before, from the files that ``rmpa run`` keeps."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rmpa.bridge.proxy_names import proxied_peer
from rmpa.cli.output import duration, warn
from rmpa.cli.resource_graph import SeenResource
from rmpa.config.state_dir import module_dir, state_dir
from rmpa.resource.run.registry_writer import FILE
from rmpa.resource.run.resource_registry import ResourceRegistry
from rmpa.resource.run.store import read_state

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path


@dataclass(frozen=True, slots=True)
class KnownResource:
    """A resource that was seen before.

    Args:
        module: The module that saw it; the names are those of its graph.
        seen: The resource as it was then.
        first: When it was seen first, Unix seconds.
        last: When it was seen last, Unix seconds.
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
        """For a column of states."""
        return f"last seen {duration(self.ago)} ago, not here now"


def remembered(module: str | None, state: str | None, here: Iterable[SeenResource]) -> list[KnownResource]:
    """The resources that were seen before and are not here now, the latest first.

    Args:
        module: The module that saw them; ``None``: any of this machine.
        state: The state directory; ``None``: the default of ``rmpa run``.
        here: The resources that are here.
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
        warn(str(error))
        return []
    latest: dict[tuple[str, str | None], KnownResource] = {}
    for each in ResourceRegistry(rows).all:  # the latest first
        peer = proxied_peer(each.caller)
        one = KnownResource(
            path.parent.name,
            SeenResource(each.path, peer, each.caller, each.descriptor),
            each.first_ns / 1e9,
            each.last_ns / 1e9,
        )
        latest.setdefault((each.path, peer), one)
    return list(latest.values())
