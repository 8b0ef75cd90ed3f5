"""Units of quality attributes and their conversion: ``20 Hz``, ``50 ms``, ``2 MB/s``."""

from __future__ import annotations

import math
import re
from typing import Final

from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError

_DIMENSIONS: Final[dict[str, dict[str, float]]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0},
    "frequency": {"Hz": 1.0, "mHz": 1e-3, "kHz": 1e3, "MHz": 1e6},
    "data rate": {
        "B/s": 1.0,
        "kB/s": 1e3,
        "MB/s": 1e6,
        "GB/s": 1e9,
        "kbit/s": 125.0,
        "Mbit/s": 125e3,
        "Gbit/s": 125e6,
    },
    "data": {"B": 1.0, "kB": 1e3, "MB": 1e6, "GB": 1e9},
    "length": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "um": 1e-6, "µm": 1e-6},
    "speed": {"m/s": 1.0, "mm/s": 1e-3, "cm/s": 1e-2, "km/h": 1 / 3.6},
    "angle": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180},
    "angular speed": {"rad/s": 1.0, "deg/s": math.pi / 180, "rpm": math.pi / 30},
    "ratio": {"": 1.0, "%": 0.01},
    "energy": {"J": 1.0, "kJ": 1e3, "Wh": 3600.0, "kWh": 3.6e6},
    "power": {"W": 1.0, "mW": 1e-3, "kW": 1e3},
    "voltage": {"V": 1.0, "mV": 1e-3},
    "current": {"A": 1.0, "mA": 1e-3},
    "temperature": {"°C": 1.0},
    "pixels": {"px": 1.0, "Mpx": 1e6},
}
_DIMENSION_OF: Final = {unit: name for name, units in _DIMENSIONS.items() for unit in units}
_QUANTITY: Final = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(\S*)\s*")


def convert(value: float, unit: str, to: str, where: str) -> float:
    """Convert a value to another unit of the same dimension.

    Args:
        value: The value, in ``unit``.
        unit: The unit of the value. A unit that is not known here converts only to itself.
        to: The unit of the result.
        where: The purpose of the value, for errors.

    Raises:
        ConfigError: A unit is unknown, or the two units have different dimensions.
    """
    if unit == to:
        return value
    dimension, wanted = _DIMENSION_OF.get(unit), _DIMENSION_OF.get(to)
    if dimension is None:
        near = did_you_mean(unit, list(_DIMENSIONS[wanted] if wanted is not None else _DIMENSION_OF))
        remedy = f"did you mean {near}?" if near else f"say it in {to}"
        raise ConfigError(where, f"{unit!r} is not a unit known here", remedy)
    if wanted != dimension:
        meant = f"a {wanted}" if wanted is not None else "of its own"
        raise ConfigError(where, f"{unit!r} is a unit of {dimension}", f"{where} is {meant}, in {to!r}")
    return value * _DIMENSIONS[dimension][unit] / _DIMENSIONS[dimension][to]


def quantity(text: str | float, to: str, where: str) -> float:
    """Read ``50 ms``, or a bare number in the unit ``to``, as a value in ``to``.

    Raises:
        ConfigError: The text is no finite number with a unit, or its unit does not convert to ``to``.
    """
    if isinstance(text, bool):
        raise ConfigError(where, f"{text} is not a number with a unit", f"for example 20 {to}".rstrip())
    if isinstance(text, int | float):
        value, unit = float(text), to
    else:
        match = _QUANTITY.fullmatch(text)
        if match is None:
            raise ConfigError(where, f"{text!r} is not a number with a unit", f"for example 20 {to}".rstrip())
        value, unit = float(match[1]), match[2] or to
    if not math.isfinite(value):
        raise ConfigError(where, f"{value} is not a number with a unit", f"for example 20 {to}".rstrip())
    return convert(value, unit, to, where)
