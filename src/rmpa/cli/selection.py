"""What a list shows of very many things: those that the user asks for, the first of them, and what was left out.

On a terminal a long list shows its first lines and says how to see the others. In a pipe, with ``--all`` and as JSON
it is complete.
"""

from __future__ import annotations

import functools
import re
import sys
from collections import Counter
from dataclasses import dataclass
from fnmatch import translate
from typing import TYPE_CHECKING, Final, TypeVar

import click

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

_T = TypeVar("_T")
_R = TypeVar("_R")

LINES: Final = 100
"""Lines of a long list that a terminal shows."""


@dataclass(frozen=True, slots=True)
class Selection:
    """The values of ``--match``, ``--peer``, ``--limit`` and ``--all`` of one command line.

    Args:
        match: Pattern of a shell for the name; empty: every name.
        peer: Pattern for the name of a module; empty: every module, and this one.
        limit: Lines to show at most; ``None``: as many as fit the way of output.
        everything: Whether nothing is left out.
    """

    match: str = ""
    peer: str = ""
    limit: int | None = None
    everything: bool = False

    def names(self, names: Iterable[str]) -> list[str]:
        """Those of the names that match, in order."""
        fits = _matcher(self.match)
        return [name for name in names if fits(name)]

    def with_peers(self, names: Iterable[str], peers: Callable[[str], Iterable[str]]) -> list[str]:
        """Those of the names that match and that a wanted module has; ``peers`` returns the modules of a name."""
        fits = _matcher(self.peer)
        return [name for name in self.names(names) if not self.peer or any(map(fits, peers(name)))]

    def wants_peer(self, peer: str | None) -> bool:
        """Whether what this module has is wanted; ``None``: this agent's own."""
        return not self.peer or (peer is not None and _matcher(self.peer)(peer))

    @property
    def lines(self) -> int | None:
        """How many lines are shown; ``None``: all."""
        if self.everything:
            return None
        if self.limit is not None:
            return self.limit
        return LINES if sys.stdout.isatty() else None

    def shown(self, items: Sequence[_T]) -> Sequence[_T]:
        """The first ones, as many as are shown."""
        return items if self.lines is None else items[: self.lines]

    def is_long(self, items: Sequence[object]) -> bool:
        """Whether some of the items are left out."""
        return self.lines is not None and len(items) > self.lines

    def print_rest(self, items: Sequence[object], what: str, filters: str) -> None:
        """Say what was left out, and how to see it; nothing if all are shown.

        Args:
            items: All of them.
            what: What they are, in the plural.
            filters: Options that select fewer, for the user to try.
        """
        if self.is_long(items):
            left = len(items) - (self.lines or 0)
            click.secho(f"... {left:,} more {what}; fewer: {filters}; all: --all", fg="yellow")


def summary(total: int, what: str, counts: Iterable[str]) -> str:
    """``200 peers: 198 linked, 2 refused``, the most frequent first."""
    parts = [f"{count:,} {word}" for word, count in Counter(counts).most_common()]
    return f"{total:,} {what}: {', '.join(parts)}"


def selection_options(function: Callable[..., _R]) -> Callable[..., _R]:
    """Decorate a list with ``--match``, ``--peer``, ``--limit`` and ``--all``; it gets them as ``selection``."""

    @functools.wraps(function)
    def command(*, match: str, peer: str, limit: int | None, everything: bool, **arguments: object) -> _R:
        return function(**arguments, selection=Selection(match, peer, limit, everything))

    options = [
        click.option("--match", default="", metavar="PATTERN", help="Only names like this: '*/scan', 'arm?'."),
        click.option("--peer", default="", metavar="PATTERN", help="Only of modules with names like this."),
        click.option("--limit", type=click.IntRange(1), help=f"At most so many. [default: {LINES} on a terminal]"),
        click.option("--all", "everything", is_flag=True, help="Leave nothing out on a terminal."),
    ]
    decorated: Callable[..., _R] = command
    for option in reversed(options):
        decorated = option(decorated)
    return decorated


@functools.lru_cache(maxsize=8)
def _matcher(pattern: str) -> Callable[[str], bool]:
    if not pattern:
        return lambda _: True
    compiled = re.compile(translate(pattern))
    return lambda name: compiled.match(name) is not None
