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
"""A soft bound that a profile is declared to miss may be missed by this factor more before it counts as violated."""


class ViolationDetector:
    """Judges windows of measured quality against the merged requirements, under one profile.

    Args:
        attributes: By name.
        violations: ``k``.
        windows: ``n``.
    """

    def __init__(self, attributes: Mapping[str, Attribute], violations: int, windows: int) -> None:
        self._attributes = attributes
        self._needed = violations
        self._windows: deque[tuple[float, tuple[Shortfall, ...]]] = deque(maxlen=windows)

    def clear(self) -> None:
        """Forget all windows: the profile or the requirements have changed."""
        self._windows.clear()

    def add(
        self, began: float, measured: Mapping[str, Value], bounds: Mapping[str, Bound], offers: Mapping[str, Value]
    ) -> None:
        """Judge a window; attributes that were not measured are left out.

        Args:
            began: When it began, monotonic seconds.
            measured: By attribute.
            bounds: The merged requirements.
            offers: The declared quality of the profile that runs.
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
        """The beginnings and shortfalls of the violated ones among the last windows."""
        return [(began, short) for began, short in self._windows if short]

    @property
    def disturbed(self) -> bool:
        """Whether enough of the last windows are violated."""
        return len(self.violated) >= self._needed

    def _violates(self, name: str, bound: Bound, value: Value, offer: Value | None) -> bool:
        attribute = self._attributes[name]
        if bound.met_by(attribute, value):
            return False
        if bound.hard or offer is None or bound.met_by(attribute, offer):
            return True
        # The profile was chosen although it misses this soft bound by so much.
        beyond, declared = bound.excess(attribute.position(value)), bound.excess(attribute.position(offer))
        return beyond > EXPECTED * declared
