"""The resources that this module's graph has shown, and when.

The registry is kept as rows of a store, two for each resource: its last descriptor, and the times when it was first
and last seen. The times change often, so their row is short. The registry is bounded: when it is full, the resource
that was seen least recently is removed.
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
"""A resource's name in this module's graph, and the node that publishes its descriptor there: its own or a proxy."""
Rows = dict["Key", str | None]


class _Times(msgspec.Struct, frozen=True):
    """When a resource was first and last seen, in Unix nanoseconds of the wall clock."""

    first_ns: int
    last_ns: int


@dataclass(slots=True)
class RegistryEntry:
    """One resource.

    Args:
        path: Name of the resource in this module's graph.
        caller: The node that published its descriptor: its own node or a proxy.
        text: The last descriptor, as JSON.
        first_ns: When the resource was first seen, Unix nanoseconds.
        last_ns: When the resource was last seen, Unix nanoseconds.
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
            RmpaError: The text is no valid descriptor; entries of a ``ResourceRegistry`` are always valid.
        """
        return Descriptor.parse(self.text)


class ResourceRegistry:
    """All resources that were seen. The methods that change it return the rows to write to the store.

    Args:
        rows: The store's rows, which are untrusted: invalid ones are left out.
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
        """Record a descriptor that ``caller`` has published at ``now_ns`` (Unix nanoseconds).

        Returns:
            The rows to write; a value of ``None`` deletes a row.

        Raises:
            RmpaError: The text is no valid descriptor.
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
        """Record which resources are present at ``now_ns`` (Unix nanoseconds); returns the rows to write.

        A present resource's time is written once in ``limits.KNOWN_WRITE`` seconds, to spare flash memory.
        """
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
        """The rows with the times of all resources that are present."""
        rows: Rows = {}
        for place in self._present:
            rows |= self._times(place)
        return rows

    def _is_due(self, place: Place, now_ns: int) -> bool:
        """Whether a resource's times must be written now; also after the wall clock was set far back or forth."""
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
    return " ".join(place)  # both parts are ROS names, which have no spaces
