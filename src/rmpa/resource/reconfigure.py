"""The messages of dynamic_reconfigure (wiki.ros.org/dynamic_reconfigure) for a resource's parameters.

A number out of range is clipped, as by dynamic_reconfigure's own servers; any other invalid value is an error. Two
parameters are not declared by the user: ``profile`` (empty: the resource decides) and, where there are contexts,
``context`` (empty: the rules decide).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from rmpa.config.values import suggestion
from rmpa.core.errors import ConfigError
from rmpa.core.limits import INT32_MAX, INT32_MIN
from rmpa.resource.declare import Parameter

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rmpa.resource.declare import ParameterValue
    from rmpa.resource.resource import Resource
    from rmpa.ros.types.messages import Plain

DESCRIPTION_TYPE: Final = "dynamic_reconfigure/ConfigDescription"
PROFILE: Final = "profile"
CONTEXT: Final = "context"
# Name that enumerations show for an empty ``profile`` or ``context``.
AUTOMATIC: Final = "automatic"
# The type of the values in each list of a ``Config``.
_LISTS: Final = {"bools": bool, "ints": int, "strs": str, "doubles": float}
# The group of all parameters: the one that every server has.
_GROUP: Final[dict[str, Plain]] = {"name": "Default", "id": 0, "parent": 0}


@dataclass(eq=False)
class ChoiceParameter(Parameter):
    """``profile`` or ``context``: one of the declared ones, or empty.

    Args:
        names: The name that tools show, and the description, by value.
    """

    names: dict[str, tuple[str, str]] = field(default_factory=dict)

    def check(self, value: ParameterValue) -> str:
        """Find the value by the value itself, or by its shown name in any case.

        Raises:
            ConfigError: The enumeration has no such value.
        """
        names = [name for name, _ in self.names.values()]
        listed = f"it is one of {', '.join(names)}"
        if not isinstance(value, str):
            raise ConfigError(self.name, f"{value!r} is no text", listed)
        for one, (name, _) in self.names.items():
            if value == one or value.lower() == name.lower():
                return one
        problem = f"there is no {self.name} {value[:80]!r}"
        raise ConfigError(self.name, problem, suggestion(value, names, listed))


def entries(resource: Resource) -> dict[str, Parameter]:
    """All parameters of a resource: the declared ones in order, then ``profile`` and ``context``."""
    found = dict(resource.parameters)
    profiles = ((one.name, one.description) for one in resource.profiles.values())
    found[PROFILE] = _choice(PROFILE, "the profile to run; empty: the resource decides", profiles)
    if resource.contexts:
        contexts = ((one.name, one.when) for one in resource.contexts.values())
        found[CONTEXT] = _choice(CONTEXT, "the context to be in; empty: its rules decide", contexts)
    return found


def _choice(name: str, text: str, choices: Iterable[tuple[str, str]]) -> ChoiceParameter:
    names = {value: (value, description) for value, description in choices}
    free = AUTOMATIC
    while free in (value.lower() for value in names):
        free = f"({free})"
    return ChoiceParameter(name, "", description=text, names={"": (free, "not chosen by hand"), **names})


def lists(values: Mapping[str, ParameterValue]) -> dict[str, Plain]:
    """Make the plain values of a ``Config`` that asks a server for some values; the others stay."""
    return {
        key: [{"name": name, "value": value} for name, value in values.items() if type(value) is kind]
        for key, kind in _LISTS.items()
    }


def config(values: Mapping[str, ParameterValue]) -> dict[str, Plain]:
    """Make the plain values of a ``Config`` with all values of a server, by parameter."""
    return lists(values) | {"groups": [{**_GROUP, "state": True}]}


def description(known: Mapping[str, Parameter]) -> dict[str, Plain]:
    """Make the plain values of a ``ConfigDescription`` message from all parameters."""
    parameters: list[Plain] = [
        {
            "name": one.name,
            "type": one.type,
            "level": 0,
            "description": f"{one.description} [{one.unit}]".lstrip() if one.unit else one.description,
            "edit_method": _edit_method(one),
        }
        for one in known.values()
    ]
    return {
        "groups": [{**_GROUP, "type": "", "parameters": parameters}],
        "min": config({name: _bound(one, low=True) for name, one in known.items()}),
        "max": config({name: _bound(one, low=False) for name, one in known.items()}),
        "dflt": config({name: one.default for name, one in known.items()}),
    }


def _bound(parameter: Parameter, *, low: bool) -> ParameterValue:
    if parameter.type == "bool":
        return not low
    if parameter.type == "str":
        return ""
    value = parameter.bounds[0 if low else 1]
    if parameter.type == "double":
        return float(value)
    # An integer's bound may be a fraction: take the nearest integer within it.
    return max(INT32_MIN, min(INT32_MAX, math.ceil(value) if low else math.floor(value)))


def _edit_method(parameter: Parameter) -> str:
    """The enumeration as clients expect it: a Python expression, which ``repr`` makes safe to evaluate."""
    names: dict[Any, tuple[str, str]] = {value: (str(value), "") for value in parameter.choices}
    if isinstance(parameter, ChoiceParameter):
        names = dict(parameter.names)
    kind = parameter.type
    enum = [
        {
            "name": name,
            "type": kind,
            "value": value,
            "description": text,
            "srcline": 0,
            "srcfile": "",
            "ctype": "std::string" if kind == "str" else kind,
            "cconsttype": "const char * const" if kind == "str" else f"const {kind}",
        }
        for value, (name, text) in names.items()
    ]
    return repr({"enum": enum, "enum_description": parameter.description}) if enum else ""


def read_config(message: Any) -> dict[str, ParameterValue]:
    """The values of a ``Config`` message by parameter; groups are ignored, since there is only one.

    Raises:
        ConfigError: The message has a parameter twice.
    """
    found: dict[str, ParameterValue] = {}
    for key, kind in _LISTS.items():
        for pair in getattr(message, key):
            name = str(pair.name)
            if name in found:
                raise ConfigError(f"parameter {name[:80]}", "it is given twice", "say it once")
            found[name] = kind(pair.value)
    return found


def checked(name: str, value: ParameterValue, known: Mapping[str, Parameter]) -> ParameterValue:
    """Check a value that a client sets, and clip a number to its bounds.

    Raises:
        ConfigError: The name is unknown or the value is invalid.
    """
    parameter = known.get(name)
    if parameter is None:
        remedy = suggestion(name, known, f"there are {', '.join(known)}")
        raise ConfigError(f"parameter {name[:80]}", "there is none of this name", remedy)
    number = parameter.type in ("int", "double") and not parameter.choices
    if number and isinstance(value, int | float) and not isinstance(value, bool):
        # The bounds are converted to the parameter's type, since a float is no value of an int parameter.
        low, high = _bound(parameter, low=True), _bound(parameter, low=False)
        value = low if value < float(low) else high if value > float(high) else value
    return parameter.check(value)
