"""The places of modules on the ring of the first page: a module keeps its place for as long as it is known.

The ring is divided into slots. A module that is found takes a free slot and moves no other. Only when all slots are
taken the ring gets more of them; the order around the ring stays, and the free slots are spread evenly.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rmpa.web.monitor import limits

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

_SIZES: Final = (4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256)


class Places:
    """Slots by module; slot 0 is at the top of the ring and belongs to the first module, the agent's own.

    Args:
        own: The agent's own module.
    """

    def __init__(self, own: str) -> None:
        self._slots = _SIZES[0]
        self._places: dict[str, int] = {own: 0}
        self._seen: dict[str, float] = {}
        self._own = own

    @property
    def slots(self) -> int:
        """The number of slots around the ring."""
        return self._slots

    @property
    def places(self) -> Mapping[str, int]:
        """The slot of each module, also of those that have left and whose place is kept."""
        return self._places

    def update(self, present: Iterable[str], now: float) -> None:
        """Give a place to each module of ``present``; release places of modules that left long ago.

        Args:
            present: Names of the modules that are known; of more than ``limits.MODULES_SHOWN`` the first in order.
            now: Seconds of any clock that never goes back.
        """
        for name in present:
            self._seen[name] = now
        self._seen[self._own] = now
        for name, seen in list(self._seen.items()):
            if now - seen > limits.FORGET_AFTER:
                self._forget(name)
        for name in sorted(self._seen.keys() - self._places.keys()):
            if len(self._places) >= limits.MODULES_SHOWN and not self._forget_oldest(now):
                del self._seen[name]
                continue
            self._grow(len(self._places) + 1)
            self._places[name] = self._free_slot()

    def absent(self, present: Iterable[str]) -> list[str]:
        """Modules whose place is kept although they are not in ``present``, in order of their names."""
        return sorted(self._places.keys() - set(present) - {self._own})

    def seen(self, name: str) -> float:
        """When a module that has a place was present last, on the clock of ``update``."""
        return self._seen[name]

    def _forget(self, name: str) -> None:
        self._seen.pop(name, None)
        self._places.pop(name, None)

    def _forget_oldest(self, now: float) -> bool:
        """Release the place of the module that left first; whether there was one that had left."""
        name = min(self._places.keys() - {self._own}, key=lambda each: self._seen.get(each, 0.0), default=None)
        if name is None or self._seen.get(name, 0.0) >= now:
            return False
        self._forget(name)
        return True

    def _grow(self, wanted: int) -> None:
        """Make room for so many modules; the order around the ring stays."""
        if wanted <= self._slots:
            return
        slots = next(size for size in _SIZES if size >= wanted)
        order = sorted(self._places, key=self._places.__getitem__)
        self._places = {name: index * slots // len(order) for index, name in enumerate(order)}
        self._slots = slots

    def _free_slot(self) -> int:
        """The free slot that is farthest from all taken ones; the first of several."""
        taken = set(self._places.values())

        def distance(slot: int) -> int:
            return min(min((slot - other) % self._slots, (other - slot) % self._slots) for other in taken)

        return max((slot for slot in range(self._slots) if slot not in taken), key=distance)
