"""What a resource remembers over a restart: its configuration, the profile that ran, and what clients asked.

Kept as rows (kind, name) -> JSON text by ``resource.run.store``. What no longer fits the declaration (a parameter of
other bounds, a profile that is gone) is left out and said; the rest counts.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.core.errors import ConfigError
from rmpa.resource.decide.adaptation import CoolDown
from rmpa.resource.declare.requirement_text import parse_requirement

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rmpa.resource.declare.attributes import Attribute
    from rmpa.resource.declare.requirements import Requirement
    from rmpa.resource.declare.resource import ParameterValue, Resource

Key = tuple[str, str]
"""Kind and name of a row."""
PARAMETER: Final = "parameter"
REQUIREMENT: Final = "requirement"
PROFILE: Final = "profile"
CHOSEN: Final = (PROFILE, "chosen")
"""The profile that was chosen by hand, or empty."""
LAST: Final = (PROFILE, "last")
"""The profile that ran last."""
COOL_DOWN: Final = "cool_down"
CONTEXT: Final = ("context", "chosen")
"""The context that was chosen by hand, or empty."""
_SECOND: Final = 1_000_000_000


class SavedRequirement(msgspec.Struct, frozen=True, kw_only=True):
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
        found = parse_requirement(self.client, list(self.values), attributes, resource, now)
        if self.expires_ns is None or found.expires is None:
            return replace(found, expires=None)
        if self.expires_ns <= now_ns:
            return None
        # A clock that was set back meanwhile does not make it longer than was asked.
        return replace(found, expires=min(found.expires, now + (self.expires_ns - now_ns) / _SECOND))


class SavedCoolDown(msgspec.Struct, frozen=True, kw_only=True):
    """A profile that is left out, for it failed or disappointed.

    Attributes:
        until_ns: By the wall clock, Unix nanoseconds.
        cool_down: Seconds for which it was left out; the next time it is longer.
        why: What was wrong.
    """

    until_ns: int
    cool_down: float
    why: str = ""

    def serialize(self) -> str:
        """As JSON."""
        return msgspec.json.encode(self).decode()

    def left(self, now: float, now_ns: int) -> CoolDown | None:
        """The same by the monotonic clock; ``None`` if it is over.

        Where the wall clock was set back meanwhile it lasts as long as the whole cool-down; where it was set forward
        it is over early, and the profile is only tried sooner.
        """
        left = min((self.until_ns - now_ns) / _SECOND, self.cool_down)
        return CoolDown(now + left, self.cool_down, self.why) if left > 0 else None


@dataclass(frozen=True, slots=True)
class SavedState:
    """What there was before.

    Args:
        parameters: Those that fit, by name.
        chosen: The profile chosen by hand, or empty.
        last: The profile that ran last, or empty.
        context: The context chosen by hand, or empty.
        asked: By clients that may come back.
        cooling: Profiles that are left out, by name.
        lost: What no longer fits, each ready to read.
    """

    parameters: Mapping[str, ParameterValue] = field(default_factory=dict, hash=False)
    chosen: str = ""
    last: str = ""
    context: str = ""
    asked: Sequence[SavedRequirement] = ()
    cooling: Mapping[str, SavedCoolDown] = field(default_factory=dict, hash=False)
    lost: Sequence[str] = ()


def recall(rows: Mapping[Key, str], resource: Resource, now_ns: int) -> SavedState:
    """Read the rows of a store for a resource as it is declared now.

    Args:
        rows: Of any content: a store is a file.
        resource: Declared completely.
        now_ns: The wall clock.
    """
    parameters: dict[str, ParameterValue] = {}
    asked: list[SavedRequirement] = []
    cooling: dict[str, SavedCoolDown] = {}
    lost: list[str] = []
    chosen = {LAST: "", CHOSEN: "", CONTEXT: ""}
    attributes = resource.attributes
    for (kind, name), text in rows.items():
        try:
            if kind == PARAMETER:
                parameters[name] = _parameter(resource, name, text)
            elif kind == REQUIREMENT:
                one = msgspec.json.decode(text, type=SavedRequirement)
                if one.requirement(attributes, resource.name, 0.0, now_ns) is not None:
                    asked.append(one)
            elif kind == COOL_DOWN:
                cooling[name] = _cooling(resource, name, text)
            elif (kind, name) in chosen:
                chosen[kind, name] = _chosen(kind, text, resource)
        except (ConfigError, msgspec.DecodeError, RecursionError) as error:
            lost.append(f"{kind} {name}: {error}")
    return SavedState(parameters, chosen[CHOSEN], chosen[LAST], chosen[CONTEXT], tuple(asked), cooling, tuple(lost))


def _parameter(resource: Resource, name: str, text: str) -> ParameterValue:
    if name not in resource.parameters:
        raise ConfigError(f"parameter {name}", "it is declared no longer")
    value = msgspec.json.decode(text, type=bool | int | float | str)
    # JSON has one kind of number: 1.0 may come back as 1, which ``check`` takes for a number with a point.
    return resource.parameters[name].check(value)


def _cooling(resource: Resource, name: str, text: str) -> SavedCoolDown:
    if name not in resource.profiles:
        raise ConfigError(f"profile {name}", "it is declared no longer")
    return msgspec.json.decode(text, type=SavedCoolDown)


def _chosen(kind: str, text: str, resource: Resource) -> str:
    name = msgspec.json.decode(text, type=str)
    if name and name not in (resource.profiles if kind == PROFILE else resource.contexts):
        raise ConfigError(f"{kind} {name}", "it is declared no longer")
    return name
