"""Fuzz target: what any node of any module may send to a resource's configuration, and rules of contexts."""

from __future__ import annotations

from rmpa.core.errors import ConfigError
from rmpa.resource.actuation import read_config
from rmpa.resource.expression import parse_expression
from rmpa.resource.reconfigure import ChoiceParameter, checked, config, entries
from rmpa.resource.resource import Resource
from rmpa.ros.types.descriptor import CONFIG_TYPE
from rmpa.ros.types.messages import MessageError, MessageType

_ONE = Resource("one", role="sensing")
_ONE.parameter("gain", 1.0, low=0.5, high=2.0)
_ONE.parameter("count", 1, low=0)
_ONE.parameter("word", "a", choices=("a", "b"))
_ONE.parameter("on", True)
_ONE.profile(offers={}, name="plain")(lambda: None)
_ONE.context("docked", when="~on")
_KNOWN = entries(_ONE)
_CONFIG = MessageType(CONFIG_TYPE)


def _message(**values: bool | float | str) -> bytes:
    return b"C" + _CONFIG.serialize(_CONFIG.make(config(values)))


SEEDS: list[bytes] = [
    _message(gain=1.5, count=2, word="b", on=False, profile="plain", context="docked"),
    _message(gain=float("nan")),
    _message(profile="automatic"),
    b"R/battery/charging == true and ~gain > 3",
    b"Rnot (~on or /a.b.c <= -1.5e3) and ~word != 'a b'",
    b"R((((~on))))",
]


def fuzz(data: bytes) -> None:
    """A documented error, or values that the parameters can have."""
    if data[:1] == b"R":
        _rule(data[1:].decode("utf-8", "replace"))
        return
    try:
        values = read_config(_CONFIG.deserialize(data[1:]))
        found = {name: checked(name, value, _KNOWN) for name, value in values.items()}
    except (MessageError, ConfigError) as error:
        str(error)
        return
    for name, value in found.items():
        parameter = _KNOWN[name]
        if not isinstance(parameter, ChoiceParameter):
            parameter.check(value)
        elif value not in parameter.names:
            raise AssertionError(f"{name} = {value!r} was let through")


def _rule(text: str) -> None:
    try:
        rule = parse_expression(text, _ONE.parameters)
    except ConfigError as error:
        str(error)
        return
    for value in (True, -1.5, "a"):
        if rule.holds(dict.fromkeys(rule.references, value)) is None:
            raise AssertionError(f"{text!r}: all is known, and still nothing decided")
    rule.holds({})
