"""Detects disturbances: a quality that is violated in ``k`` of the last ``n`` windows."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final

from rmpa.resource.decide.actions import Shortfall

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.resource.declare.attributes import Attribute, Value
    from rmpa.resource.declare.requirements import Bound

EXPECTED: Final = 1.25
"""Factor by which a soft bound may be missed further than the profile declares, before it counts as violated."""


class ViolationDetector:
    """Judges windows of measured quality against the merged requirements, under one profile.

    Args:
        attributes: The resource's attributes, by name.
        violations: ``k``, the number of violated windows that are a disturbance.
        windows: ``n``, the number of last windows that are kept.
    """

    def __init__(self, attributes: Mapping[str, Attribute], violations: int, windows: int) -> None:
        self._attributes = attributes
        self._needed = violations
        self._windows: deque[tuple[float, tuple[Shortfall, ...]]] = deque(maxlen=windows)

    def clear(self) -> None:
        """Forget all windows, because the profile or the requirements have changed."""
        self._windows.clear()

    def add(
        self, began: float, measured: Mapping[str, Value], bounds: Mapping[str, Bound], offers: Mapping[str, Value]
    ) -> None:
        """Judge a window; attributes that were not measured are left out.

        Args:
            began: When the window began, in monotonic seconds.
            measured: Measured values by attribute.
            bounds: The merged requirements by attribute.
            offers: The declared quality of the profile that runs, by attribute.
        """
        self._windows.append(
            (
                began,
                tuple(
                    Shortfall(name, bound, measured[name])
                    for name, bound in bounds.items()
                    if name in measured and self._violates(name, bound, measured[name], offers.get(name))
                ),
            )
        )

    @property
    def violated(self) -> list[tuple[float, tuple[Shortfall, ...]]]:
        """The violated windows among the last ``n``, oldest first: when each began, and its shortfalls."""
        return [(began, short) for began, short in self._windows if short]

    @property
    def disturbed(self) -> bool:
        """Whether at least ``k`` of the last ``n`` windows are violated."""
        return len(self.violated) >= self._needed

    def _violates(self, name: str, bound: Bound, value: Value, offer: Value | None) -> bool:
        attribute = self._attributes[name]
        if bound.met_by(attribute, value):
            return False
        if bound.hard or offer is None or bound.met_by(attribute, offer):
            return True
        # The profile was chosen although it is declared to miss this soft bound; judge by how far it misses it.
        beyond, declared = bound.excess(attribute.position(value)), bound.excess(attribute.position(offer))
        return beyond > EXPECTED * declared
