"""Calls the listeners of a core after each change of its graph."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from rmpa.core.log import logged_failure

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rmpa.ros.master.effects import GraphChange

_log = logging.getLogger(__name__)


class GraphListeners:
    """The listeners of one core; an exception of one is logged, and affects neither the others nor a node."""

    def __init__(self) -> None:
        self._callbacks: list[Callable[[GraphChange], None]] = []

    def add(self, callback: Callable[[GraphChange], None]) -> None:
        """Call ``callback`` after each change from now on."""
        self._callbacks.append(callback)

    def notify(self, changes: Iterable[GraphChange]) -> None:
        """Log changes and call the listeners, in order."""
        for change in changes:
            _log.info("= %s %s %s of %s", "+" if change.added else "-", change.kind.value, change.name, change.node)
            for callback in self._callbacks:
                with logged_failure(_log, "a listener failed at %s", change):
                    callback(change)
