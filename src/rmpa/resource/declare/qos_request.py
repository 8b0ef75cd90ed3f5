"""QoS requests in the form in which a user writes them: ``at_least("20 Hz", hard=True)``."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from rmpa.resource.declare.requirements import Bound, bound

if TYPE_CHECKING:
    from rmpa.resource.declare.attributes import Attribute


@dataclass(frozen=True, slots=True)
class QoSRequest:
    """The requested quality of one attribute, before the attributes of the resource are known."""

    at_least: float | str | None = None
    at_most: float | str | None = None
    exactly: float | str | tuple[str, ...] | None = None
    weight: float = 1.0
    hard: bool = False

    def __str__(self) -> str:
        """The text form that ``resource.declare.requirement_text`` reads: ``>= 20 Hz hard weight=2``."""
        if self.exactly is not None:
            values = self.exactly if isinstance(self.exactly, tuple) else (self.exactly,)
            text = "= " + " | ".join(map(str, values))
        elif self.at_least is not None and self.at_most is not None:
            text = f"{self.at_least} .. {self.at_most}"
        else:
            text = f">= {self.at_least}" if self.at_least is not None else f"<= {self.at_most}"
        hard = " hard" if self.hard else ""
        return text + hard + (f" weight={self.weight:g}" if self.weight != 1 else "")

    def bound(self, attribute: Attribute) -> Bound:
        """The request as a bound of an attribute.

        Raises:
            ConfigError: The request is not valid for that attribute; see ``requirements.bound``.
        """
        return bound(attribute, **asdict(self))


def at_least(value: float | str, *, hard: bool = False, weight: float = 1.0) -> QoSRequest:
    """Request this value or more: ``at_least("20 Hz")``."""
    return QoSRequest(at_least=value, hard=hard, weight=weight)


def at_most(value: float | str, *, hard: bool = False, weight: float = 1.0) -> QoSRequest:
    """Request this value or less: ``at_most("50 ms")``."""
    return QoSRequest(at_most=value, hard=hard, weight=weight)


def exactly(*values: float | str, hard: bool = False, weight: float = 1.0) -> QoSRequest:
    """Request this value, or one of several words: ``exactly("mono8", "rgb8")``."""
    one: Any = values[0] if len(values) == 1 else tuple(map(str, values))
    return QoSRequest(exactly=one, hard=hard, weight=weight)


def between(low: float | str, high: float | str, *, hard: bool = False, weight: float = 1.0) -> QoSRequest:
    """Request a value within an interval: ``between("1 m", "3 m")``."""
    return QoSRequest(at_least=low, at_most=high, hard=hard, weight=weight)
