"""Requirements as texts, which any ROS tool can publish: ``rate: ">= 20 Hz hard"``, ``latency: "<= 50 ms weight=2"``.

::

    request = bound { " hard" | " weight=" number }
    bound   = ">=" value | "<=" value | "=" value { "|" value } | value ".." value
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import ConfigError
from rmpa.resource import limits
from rmpa.resource.declare.qos_request import QoSRequest
from rmpa.resource.declare.requirements import Requirement, find_attribute
from rmpa.resource.declare.units import quantity

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rmpa.resource.declare.attributes import Attribute
    from rmpa.resource.declare.requirements import Bound

_WEIGHT: Final = re.compile(r"weight\s*=\s*(\S+)")
_EXAMPLE: Final = 'write ">= 20 Hz", "<= 50 ms hard", "1 .. 3 m", "= word" or "= this | that weight=2"'
PRIORITY: Final = "priority"
EXPIRES: Final = "expires"


def parse_request(text: str, name: str) -> QoSRequest:
    """Read the request for one attribute.

    Args:
        text: A ``request`` of the module's grammar.
        name: The attribute's name, for errors.

    Raises:
        ConfigError: The text has a syntax error or is too long.
    """
    where = f"requirement of {name}"
    if len(text) > limits.REQUIREMENT_TEXT_MAX:
        raise ConfigError(where, f"{len(text)} characters", f"at most {limits.REQUIREMENT_TEXT_MAX}")
    rest, hard, weight = text.strip(), False, 1.0
    while True:
        if match := re.search(r"(?:^|\s)(hard|weight\s*=\s*\S+)$", rest):
            word, rest = match[1], rest[: match.start()].rstrip()
            if word == "hard":
                hard = True
            else:
                weight = _weight(word, where)
        else:
            break
    if rest.startswith(">="):
        return QoSRequest(at_least=_value(rest[2:], text, where), hard=hard, weight=weight)
    if rest.startswith("<="):
        return QoSRequest(at_most=_value(rest[2:], text, where), hard=hard, weight=weight)
    if rest.startswith("="):
        values = tuple(_value(part, text, where) for part in rest.lstrip("=").split("|"))
        return QoSRequest(exactly=values if len(values) > 1 else values[0], hard=hard, weight=weight)
    low, dots, high = rest.partition("..")
    if dots:
        return QoSRequest(
            at_least=_value(low, text, where), at_most=_value(high, text, where), hard=hard, weight=weight
        )
    raise ConfigError(where, f"{text!r} is no bound", _EXAMPLE)


def _weight(word: str, where: str) -> float:
    match = _WEIGHT.fullmatch(word)
    try:
        return float(match[1]) if match else 1.0
    except ValueError:
        raise ConfigError(where, f"{word!r} is no weight", "for example weight=2") from None


def _value(text: str, whole: str, where: str) -> str:
    if not text.strip():
        raise ConfigError(where, f"{whole!r} lacks a value", _EXAMPLE)
    return text.strip()


def parse_bound(text: str, name: str, attributes: Mapping[str, Attribute], resource: str) -> Bound:
    """Read the request for one attribute of a resource.

    Raises:
        ConfigError: The text has a syntax error, the attribute is unknown, or the request is not valid for it.
    """
    attribute = find_attribute(attributes, name, resource)
    request = parse_request(text, name)
    if request.at_least is not None and request.at_most is not None and not attribute.has_words:
        request = _share_unit(request)
    return request.bound(attribute)


def _share_unit(request: QoSRequest) -> QoSRequest:
    """Apply the unit of the upper bound to a lower bound without a unit: ``1 .. 3 m`` means ``1 m .. 3 m``."""
    low, high = str(request.at_least), str(request.at_most)
    unit = re.search(r"[^\d.eE+\-\s]\S*$", high)
    if unit and re.fullmatch(r"[-+]?[\d.]+(?:[eE][-+]?\d+)?", low):
        low = f"{low} {unit[0]}"
    return QoSRequest(at_least=low, at_most=high, weight=request.weight, hard=request.hard)


def parse_requirement(
    client: str, values: Iterable[tuple[str, str]], attributes: Mapping[str, Attribute], resource: str, now: float
) -> Requirement:
    """Read the whole requirement of one client.

    Args:
        client: Name of the client's node.
        values: Attributes with their texts; optionally ``priority`` (a whole number) and ``expires`` (a duration).
        attributes: The attributes of the resource, by name.
        resource: Name of the resource, for errors.
        now: Monotonic seconds, from which ``expires`` counts.

    Raises:
        ConfigError: A text is invalid; the error is the first one, and the whole requirement is invalid.
    """
    bounds: dict[str, Bound] = {}
    priority, expires = 0, None
    for number, (key, text) in enumerate(values):
        if number >= limits.REQUIREMENT_BOUNDS_MAX:
            raise ConfigError(f"requirement of {client}", f"more than {limits.REQUIREMENT_BOUNDS_MAX} bounds")
        if key == PRIORITY:
            priority = _priority(text)
        elif key == EXPIRES:
            seconds = quantity(text, "s", EXPIRES)
            if seconds <= 0:
                raise ConfigError(EXPIRES, f"{text!r} is over already", 'for example "30 s"')
            expires = now + seconds
        elif key in bounds:
            raise ConfigError(f"requirement of {key}", "it is asked twice", "say both in one: 1 .. 3 m")
        else:
            bounds[key] = parse_bound(text, key, attributes, resource)
    return Requirement(client, bounds, priority, expires)


def _priority(text: str) -> int:
    if not re.fullmatch(r"\s*[-+]?\d{1,9}\s*", text):
        raise ConfigError(PRIORITY, f"{text!r} is no whole number", "for example 1; the higher one wins a conflict")
    return int(text)
