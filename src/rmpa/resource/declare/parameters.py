"""Parameters of a resource: typed values with a range, which may change while it runs."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError
from rmpa.core.limits import INT32_MAX, INT32_MIN

if TYPE_CHECKING:
    from collections.abc import Callable

ParameterValue = bool | int | float | str
INT_MIN: Final = INT32_MIN
INT_MAX: Final = INT32_MAX
"""Bounds of integers, which have 32 bits in dynamic_reconfigure."""
_ROS_TYPES: Final = {bool: "bool", int: "int", float: "double", str: "str"}


@dataclass(eq=False)
class Parameter:
    """A parameter; its value may change while the resource runs.

    Args:
        name: The parameter's name, a ROS base name.
        default: The initial value; its type is the parameter's type.
        low: The least value of a number; ``None``: no declared bound.
        high: The greatest value of a number; ``None``: no declared bound.
        choices: The only valid values, if the parameter is an enumeration.
        unit: The unit, a text for people.
        description: A text for people.
        on_change: Called with the parameter, in the thread that changed it; ``None`` while the resource does not run.
    """

    name: str
    default: ParameterValue
    low: float | None = None
    high: float | None = None
    choices: tuple[ParameterValue, ...] = ()
    unit: str = ""
    description: str = ""
    on_change: Callable[[Parameter], None] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        self._value: Any = self.default
        self.given = False
        """Whether the value was given for this run (``rmpa run --set``); it then overrides stored values."""

    @property
    def value(self) -> Any:
        """The present value; may be set in any thread.

        Raises:
            ConfigError: On setting: the value is invalid.
        """
        return self._value

    @value.setter
    def value(self, value: ParameterValue) -> None:
        before, self._value = self._value, self.check(value)
        if self.on_change is not None and self._value != before:
            self.on_change(self)

    @property
    def type(self) -> str:
        """dynamic_reconfigure's type name: ``bool``, ``int``, ``double`` or ``str``."""
        return _ROS_TYPES[type(self.default)]

    @property
    def bounds(self) -> tuple[float, float]:
        """The least and the greatest value of a number: as declared, or else 32-bit for ``int`` and infinite."""
        low, high = (INT_MIN, INT_MAX) if isinstance(self.default, int) else (-math.inf, math.inf)
        return self.low if self.low is not None else low, self.high if self.high is not None else high

    def check_declaration(self, where: str) -> None:
        """Check the arguments of ``Resource.parameter``.

        Raises:
            ConfigError: The default's type is unknown, the bounds are the wrong way round or given for no number, or
                the default or a choice is invalid.
        """
        if type(self.default) not in _ROS_TYPES:
            raise ConfigError(
                where, f"{self.default!r} is no bool, int, float or str", "give a default of one of these"
            )
        if (self.low is not None or self.high is not None) and isinstance(self.default, bool | str):
            raise ConfigError(where, f"bounds of {self.default!r}, which is no number", "leave low and high out")
        if self.low is not None and self.high is not None and self.low > self.high:
            raise ConfigError(
                where, f"low is {self.low:g} and high {self.high:g}", "the bounds are the wrong way round"
            )
        for value in (*self.choices, self.default):
            self.check(value)

    def check(self, value: ParameterValue) -> ParameterValue:
        """Return the value, converted to ``float`` where that is the parameter's type.

        Raises:
            ConfigError: The value is of another type, out of range, or none of the choices.
        """
        where = f"parameter {self.name}"
        if isinstance(self.default, float) and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if type(value) is not type(self.default):
            raise ConfigError(where, f"{value!r} is no {self.type}", f"for example {self.default!r}")
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(where, f"{value} is no number that can be used", f"for example {self.default!r}")
        if self.choices and value not in self.choices:
            near = did_you_mean(str(value), map(str, self.choices))
            remedy = f"did you mean {near}?" if near else f"it is one of {', '.join(map(str, self.choices))}"
            raise ConfigError(where, f"{value!r} is none of its values", remedy)
        if not isinstance(value, str | bool):
            low, high = self.bounds
            if value < low:
                raise ConfigError(where, f"{value:g} is too little", f"the least is {low:g}")
            if value > high:
                raise ConfigError(where, f"{value:g} is too much", f"the most is {high:g}")
        return value
