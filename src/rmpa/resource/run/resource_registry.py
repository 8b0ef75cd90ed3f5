"""The resources that this module's graph has shown, and when.

Kept as rows of a store, two for each resource: its last descriptor, and the times when it was seen first and last
(short, because they change often). Bounded: the resource that was seen least recently is removed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.core.errors import RmpaError
from rmpa.resource import limits
from rmpa.resource.run.descriptor import Descriptor

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from rmpa.resource.decide.saved_state import Key

DESCRIPTOR: Final = "descriptor"
SEEN: Final = "seen"
Place = tuple[str, str]
"""A resource's name in this module's graph, and the node that publishes for it there: itself, or its proxy."""
Rows = dict["Key", str | None]


class _Times(msgspec.Struct, frozen=True):
    """Unix nanoseconds of the wall clock."""

    first_ns: int
    last_ns: int


@dataclass(slots=True)
class RegistryEntry:
    """One resource.

    Args:
        path: Its name in this module's graph.
        caller: The node that published for it: itself, or its proxy.
        text: Its last descriptor, JSON.
        first_ns: When it was seen first, Unix nanoseconds.
        last_ns: When it was seen last.
    """

    path: str
    caller: str
    text: str
    first_ns: int
    last_ns: int

    @property
    def descriptor(self) -> Descriptor:
        """The parsed descriptor.

        Raises:
            RmpaError: It is invalid, which ``ResourceRegistry`` rules out.
        """
        return Descriptor.parse(self.text)


class ResourceRegistry:
    """All resources that were seen. Its methods return the rows to write to the store.

    Args:
        rows: Of the store; untrusted: invalid ones are left out.
    """

    def __init__(self, rows: Mapping[Key, str] | None = None) -> None:
        self._known: dict[Place, RegistryEntry] = {}
        self._written: dict[Place, int] = {}
        self._present: set[Place] = set()
        for (kind, name), text in (rows or {}).items():
            path, _, caller = name.partition(" ")
            times = (rows or {}).get((SEEN, name), "")
            if kind != DESCRIPTOR or not caller:
                continue
            try:
                found = msgspec.json.decode(times, type=_Times)
                Descriptor.parse(text)
            except (msgspec.DecodeError, RmpaError):
                continue
            self._known[path, caller] = RegistryEntry(path, caller, text, found.first_ns, found.last_ns)
            self._written[path, caller] = found.last_ns

    @property
    def all(self) -> list[RegistryEntry]:
        """All entries, the most recently seen first."""
        return sorted(self._known.values(), key=lambda each: (-each.last_ns, each.path, each.caller))

    def record(self, path: str, caller: str, text: str, now_ns: int) -> Rows:
        """Record a descriptor.

        Raises:
            RmpaError: It is invalid.
        """
        Descriptor.parse(text)
        place = path, caller
        before = self._known.get(place)
        first_ns = before.first_ns if before is not None else now_ns
        self._known[place] = RegistryEntry(path, caller, text, first_ns, now_ns)
        rows = self._times(place) if place not in self._present or self._is_due(place, now_ns) else {}
        self._present.add(place)
        if before is None or before.text != text:
            rows[DESCRIPTOR, _name(place)] = text
        return rows | self._bound()

    def update(self, present: Collection[Place], now_ns: int) -> Rows:
        """Record which resources are present now; few times are written, to spare flash memory."""
        rows: Rows = {}
        for place in self._known.keys() & set(present):
            self._known[place].last_ns = now_ns
            if self._is_due(place, now_ns):
                rows |= self._times(place)
        for place in self._present - set(present):
            rows |= self._times(place)
        self._present = {place for place in present if place in self._known}
        return rows

    def flush(self) -> Rows:
        """The times of all resources that are present."""
        rows: Rows = {}
        for place in self._present:
            rows |= self._times(place)
        return rows

    def _is_due(self, place: Place, now_ns: int) -> bool:
        """Whether its times are due to be written; at once if the clock was set back or forth."""
        return abs(now_ns - self._written.get(place, 0)) >= limits.KNOWN_WRITE * 1e9

    def _times(self, place: Place) -> Rows:
        one = self._known.get(place)
        if one is None:
            return {}
        self._written[place] = one.last_ns
        return {(SEEN, _name(place)): msgspec.json.encode(_Times(one.first_ns, one.last_ns)).decode()}

    def _bound(self) -> Rows:
        rows: Rows = {}
        size = sum(len(each.text) for each in self._known.values())
        for each in reversed(self.all):
            if len(self._known) <= limits.KNOWN_MAX and size <= limits.KNOWN_TEXT_MAX:
                break
            place = each.path, each.caller
            del self._known[place]
            self._written.pop(place, None)
            self._present.discard(place)
            size -= len(each.text)
            rows |= {(DESCRIPTOR, _name(place)): None, (SEEN, _name(place)): None}
        return rows


def _name(place: Place) -> str:
    return " ".join(place)  # neither has a space: they are ROS names
