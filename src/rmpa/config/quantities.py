"""Durations and rates as users write them: numbers in seconds and messages a second, or texts with a unit."""

from __future__ import annotations

import math
import re
from typing import Final

from rmpa.config import limits
from rmpa.config.values import BadValue, JsonSchema, ValueType, shown

_QUANTITY: Final = re.compile(r"([0-9]{1,9}(?:\.[0-9]{1,9})?)\s*([a-zµ]*)")
_SECONDS: Final = {"us": 1e6, "µs": 1e6, "ms": 1e3, "s": 1.0, "min": 1 / 60, "h": 1 / 3600}
"""By unit: so many of it are a second. Dividing by these rounds only once, so that ``"100 ms"`` is exactly 0.1."""
_BYTES: Final = {
    "b": 1.0,
    "kb": 1e3,
    "mb": 1e6,
    "gb": 1e9,
    "kib": 1024.0,
    "mib": 1048576.0,
    "kbit": 125.0,
    "mbit": 125e3,
    "gbit": 125e6,
}
"""By unit: so many bytes it is."""
_FLOW: Final = re.compile(rf"([0-9]{{1,9}}(?:\.[0-9]{{1,9}})?)\s*({'|'.join(_BYTES)})(?:/s)?", re.IGNORECASE)
_INFINITE: Final = "infinite"
"""ROS 2's own word for a duration without a bound; it lifts the bound that an earlier rule has set."""
_UNLIMITED: Final = "unlimited"
"""The word for a rate without a bound, likewise."""


def read_duration(raw: object, what: str = "a duration") -> float | None:
    """Seconds as a number, or a text such as ``"100 ms"`` or ``"2 s"``; ``"infinite"`` is ``None``.

    Args:
        raw: As written.
        what: What the duration is, with its article, for the text of errors.

    Raises:
        BadValue: It is not a duration, or outside of 1 ms to a day.
    """
    seconds = _seconds(raw, what)
    if seconds == math.inf:
        return None
    if not limits.CONTRACT_TIME_MIN <= seconds <= limits.CONTRACT_TIME_MAX:
        bounds = f"{limits.CONTRACT_TIME_MIN:g} and {limits.CONTRACT_TIME_MAX:.0f} s"
        raise BadValue(f"{shown(raw)} is out of range", f'{what} is between {bounds}; "{_INFINITE}" is none at all')
    return seconds


def read_outage(raw: object) -> float:
    """How long messages are kept for a peer whose link is gone, in seconds; unlike other durations it has an end."""
    seconds = _seconds(raw, "an outage")
    shortest, longest = limits.OUTAGE_MIN, limits.OUTAGE_MAX
    if not shortest <= seconds <= longest:
        bounds = f"an outage is between {shortest:g} and {longest:.0f} s: messages are not kept for ever"
        raise BadValue(f"{shown(raw)} is out of range", bounds)
    return seconds


def read_timeout(raw: object) -> float:
    """How long a service call may take, in seconds; there is always an end."""
    seconds = read_duration(raw, "a timeout")
    if seconds is None or seconds > limits.SERVICE_TIMEOUT_MAX:
        raise BadValue(
            f"{raw!r} is too long for a call", f"at most {limits.SERVICE_TIMEOUT_MAX:g} s: an action can say more"
        )
    return seconds


def read_rate(raw: object) -> float | None:
    """Messages a second as a number, or a text such as ``"10 Hz"``; ``"unlimited"`` is ``None``.

    Raises:
        BadValue: It is not a rate, or outside of the bounds in ``config.limits``.
    """
    example = 'a rate is messages a second as a number, or a text such as "10 Hz"'
    if isinstance(raw, str):
        text = raw.strip().lower()
        if text == _UNLIMITED:
            return None
        number, unit = _quantity(text)
        if number and unit in _SECONDS:
            raise BadValue(f"{raw!r} is a duration, not a rate", better=f"{_SECONDS[unit] / number:g} Hz")
        if number is None or unit != "hz":
            raise BadValue(f"{raw!r} is not a rate", example)
        rate = number
    else:
        rate = _number(raw, "a rate", example)
    if rate == math.inf:
        return None
    if not limits.CONTRACT_RATE_MIN <= rate <= limits.CONTRACT_RATE_MAX:
        bounds = f"{limits.CONTRACT_RATE_MIN:g} and {limits.CONTRACT_RATE_MAX:.0f} Hz"
        raise BadValue(f"{shown(raw)} is out of range", f'a rate is between {bounds}; "{_UNLIMITED}" is none at all')
    return rate


def read_bytes_a_second(raw: object) -> int | None:
    """Bytes a second as a number, or a text such as ``"100 KB/s"`` or ``"1 Mbit/s"``; ``"unlimited"`` is ``None``.

    Raises:
        BadValue: It is not such a quantity, or outside of the bounds in ``config.limits``.
    """
    example = 'a size is bytes a second as a number, or a text such as "100 KB/s" or "1 Mbit/s"'
    if isinstance(raw, str):
        text = raw.strip()
        if text.lower() == _UNLIMITED:
            return None
        match = _FLOW.fullmatch(text)
        if match is None:
            raise BadValue(f"{raw!r} is not a number of bytes a second", example)
        found = float(match[1]) * _BYTES[match[2].lower()]
    else:
        found = _number(raw, "a number of bytes a second", example)
    if found == math.inf:
        return None
    if not 1 <= found <= limits.GATEWAY_BYTES_MAX:
        bounds = f'a size is between 1 and {limits.GATEWAY_BYTES_MAX:,} bytes a second; "{_UNLIMITED}" is none at all'
        raise BadValue(f"{shown(raw)} is out of range", bounds)
    return int(found)


def _seconds(raw: object, what: str) -> float:
    """A duration in seconds, before its bounds are checked."""
    example = f'{what} is seconds as a number, or a text such as "100 ms"'
    if not isinstance(raw, str):
        return _number(raw, "a duration", example)
    text = raw.strip().lower()
    if text == _INFINITE:
        return math.inf
    number, unit = _quantity(text)
    if number and unit == "hz":
        raise BadValue(f"{raw!r} is a rate, not a duration", better=f"{1000 / number:g} ms")
    if number is None or unit not in _SECONDS:
        raise BadValue(f"{raw!r} is not a duration", f"{example}; units are {', '.join(_SECONDS)}")
    return number / _SECONDS[unit]


def _quantity(text: str) -> tuple[float | None, str]:
    match = _QUANTITY.fullmatch(text)
    return (float(match[1]), match[2]) if match else (None, "")


def _number(raw: object, what: str, example: str) -> float:
    if isinstance(raw, bool) or not isinstance(raw, int | float) or math.isnan(raw):
        raise BadValue(f"{shown(raw)} is not {what}", example)
    return float(raw)  # TOML's whole numbers have 64 bits


def _number_or_text(*examples: object) -> JsonSchema:
    # Without "type": the reader's own error about a wrong type says more than that of config.file.
    return {"anyOf": [{"type": "number"}, {"type": "string"}], "examples": list(examples)}


def duration_of(what: str) -> ValueType[float | None]:
    """A duration that may be infinite; ``what`` names it with its article, for the text of errors."""
    return ValueType(lambda raw: read_duration(raw, what), _number_or_text(0.5, "100 ms", _INFINITE))


OUTAGE: Final = ValueType(read_outage, _number_or_text(30, "5 min"))
TIMEOUT: Final = ValueType(read_timeout, _number_or_text(60, "5 min"))
RATE: Final = ValueType(read_rate, _number_or_text(10, "10 Hz", _UNLIMITED))
BYTES_A_SECOND: Final = ValueType(read_bytes_a_second, _number_or_text(125_000, "100 KB/s", "1 Mbit/s", _UNLIMITED))
