"""What a resource remembers over a restart: its configuration, the profile that ran, and what clients asked.

Kept as rows (kind, name) -> JSON text by ``resource.aio.store``. What no longer fits the declaration (a parameter of
other bounds, a profile that is gone) is left out and said; the rest counts.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.core.errors import ConfigError
from rmpa.resource.requirement_text import EXPIRES, parse_requirement

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rmpa.resource.attributes import Attribute
    from rmpa.resource.declare import ParameterValue, Resource
    from rmpa.resource.requirements import Requirement

Key = tuple[str, str]
"""Kind and name of a row."""
PARAMETER: Final = "parameter"
REQUIREMENT: Final = "requirement"
PROFILE: Final = "profile"
CHOSEN: Final = (PROFILE, "chosen")
"""The profile that was chosen by hand, or empty."""
LAST: Final = (PROFILE, "last")
"""The profile that ran last."""
CONTEXT: Final = ("context", "chosen")
"""The context that was chosen by hand, or empty."""
_SECOND: Final = 1_000_000_000


class Asked(msgspec.Struct, frozen=True, kw_only=True):
    """What one client asked, in its own words.

    Attributes:
        client: Who.
        values: Attribute and text, ``priority``, ``expires``; as it came.
        mark: On the message that said so, and on the answers to it.
        stamp: The message's, or empty; the same one may come again (latched), and is the same request then.
        expires_ns: By the wall clock, Unix nanoseconds: the monotonic one begins anew with each boot.
    """

    client: str
    values: tuple[tuple[str, str], ...]
    mark: str = ""
    stamp: str = ""
    expires_ns: int | None = None

    def serialize(self) -> str:
        """As JSON."""
        return msgspec.json.encode(self).decode()

    def requirement(
        self, attributes: Mapping[str, Attribute], resource: str, now: float, now_ns: int
    ) -> Requirement | None:
        """The same as a requirement, or ``None`` if it has expired meanwhile.

        Raises:
            ConfigError: It asks for what the resource has no longer.
        """
        values = [(key, text) for key, text in self.values if key != EXPIRES]
        found = parse_requirement(self.client, values, attributes, resource, now)
        if self.expires_ns is None:
            return found
        if self.expires_ns <= now_ns:
            return None
        return replace(found, expires=now + (self.expires_ns - now_ns) / _SECOND)


@dataclass(frozen=True, slots=True)
class Remembered:
    """What there was before.

    Args:
        parameters: Those that fit, by name.
        chosen: The profile chosen by hand, or empty.
        last: The profile that ran last, or empty.
        context: The context chosen by hand, or empty.
        asked: By clients that may come back.
        lost: What no longer fits, each ready to read.
    """

    parameters: Mapping[str, ParameterValue] = field(default_factory=dict, hash=False)
    chosen: str = ""
    last: str = ""
    context: str = ""
    asked: Sequence[Asked] = ()
    lost: Sequence[str] = ()


def recall(rows: Mapping[Key, str], resource: Resource, now_ns: int) -> Remembered:
    """Read the rows of a store for a resource as it is declared now.

    Args:
        rows: Of any content: a store is a file.
        resource: Declared completely.
        now_ns: The wall clock.
    """
    parameters: dict[str, ParameterValue] = {}
    asked: list[Asked] = []
    lost: list[str] = []
    chosen = {LAST: "", CHOSEN: "", CONTEXT: ""}
    attributes = resource.attributes
    for (kind, name), text in rows.items():
        try:
            if kind == PARAMETER:
                parameters[name] = _parameter(resource, name, text)
            elif kind == REQUIREMENT:
                one = msgspec.json.decode(text, type=Asked)
                if one.requirement(attributes, resource.name, 0.0, now_ns) is not None:
                    asked.append(one)
            elif (kind, name) in chosen:
                chosen[kind, name] = _chosen(kind, text, resource)
        except (ConfigError, msgspec.DecodeError, RecursionError) as error:
            lost.append(f"{kind} {name}: {error}")
    return Remembered(parameters, chosen[CHOSEN], chosen[LAST], chosen[CONTEXT], tuple(asked), tuple(lost))


def _parameter(resource: Resource, name: str, text: str) -> ParameterValue:
    if name not in resource.parameters:
        raise ConfigError(f"parameter {name}", "it is declared no longer")
    value = msgspec.json.decode(text, type=bool | int | float | str)
    # JSON has one kind of number: 1.0 may come back as 1, which ``check`` takes for a number with a point.
    return resource.parameters[name].check(value)


def _chosen(kind: str, text: str, resource: Resource) -> str:
    name = msgspec.json.decode(text, type=str)
    if name and name not in (resource.profiles if kind == PROFILE else resource.contexts):
        raise ConfigError(f"{kind} {name}", "it is declared no longer")
    return name
