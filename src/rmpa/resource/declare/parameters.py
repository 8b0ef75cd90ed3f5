"""A resource's parameters: values that may change while it runs, and what they can be."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Final, Protocol

from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError
from rmpa.core.sizes import INT32_MAX, INT32_MIN
from rmpa.resource.declare.fence import passage

ParameterValue = bool | int | float | str
INT_MIN: Final = INT32_MIN
INT_MAX: Final = INT32_MAX


class ParameterWatch(Protocol):
    """Who hears of a parameter's changes while the resource runs."""

    def changed(self, parameter: Parameter) -> None:
        """It has another value; called in whichever thread set it."""
        ...


@dataclass(eq=False)
class Parameter:
    """A configuration or task parameter; its value may change while the resource runs.

    Args:
        name: A ROS base name.
        default: Its value before anybody set it; its type is the parameter's.
        low: The least value of a number.
        high: The greatest.
        choices: The only values, if there are only some.
        unit: For people.
        description: For people.
    """

    name: str
    default: ParameterValue
    low: float | None = None
    high: float | None = None
    choices: tuple[ParameterValue, ...] = ()
    unit: str = ""
    description: str = ""
    watch: ParameterWatch | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        self._value: Any = self.default
        self.given = False
        """Whether it was set for this start (``rmpa run --set``), and not what it was before counts."""

    @property
    def value(self) -> Any:
        """What it is now; whoever sets it, in any thread, is told by a ``ConfigError`` if it cannot be that.

        From the function of a profile that was given up it cannot be set any more (``LocalProtocolError``).
        """
        return self._value

    @value.setter
    def value(self, value: ParameterValue) -> None:
        with passage(f"set parameter {self.name}"):
            before, self._value = self._value, self.check(value)
            if self.watch is not None and self._value != before:
                self.watch.changed(self)

    @property
    def type(self) -> str:
        """``bool``, ``int``, ``double`` or ``str``, as dynamic_reconfigure has it."""
        kinds = {bool: "bool", int: "int", float: "double", str: "str"}
        return kinds[type(self.default)]

    @property
    def bounds(self) -> tuple[float, float]:
        """The least and the greatest value of a number; whole ones have 32 bits in dynamic_reconfigure."""
        widest = (INT_MIN, INT_MAX) if isinstance(self.default, int) else (-math.inf, math.inf)
        return (
            self.low if self.low is not None else widest[0],
            self.high if self.high is not None else widest[1],
        )

    def check(self, value: ParameterValue) -> ParameterValue:
        """A value as this parameter may have it; whole numbers are numbers with a point too.

        Raises:
            ConfigError: It is of another type, out of range, or none of the choices.
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
