"""State that survives a restart: parameters, choices by hand, the last profile, requirements and cool-downs.

``resource.run.store`` keeps the state as rows (kind, name) -> JSON text. Rows that contradict the present declaration
(a parameter out of its new range, a profile that was removed) are left out and reported.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.core.errors import ConfigError
from rmpa.resource.decide.cool_downs import CoolDown
from rmpa.resource.declare.requirement_text import parse_requirement

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rmpa.resource.declare.attributes import Attribute
    from rmpa.resource.declare.parameters import ParameterValue
    from rmpa.resource.declare.requirements import Requirement
    from rmpa.resource.declare.resource import Resource

Key = tuple[str, str]
"""Kind and name of a row."""
PARAMETER: Final = "parameter"
REQUIREMENT: Final = "requirement"
PROFILE: Final = "profile"
CHOSEN: Final = (PROFILE, "chosen")
"""Key of the profile that was chosen by hand; the value is empty if none was."""
LAST: Final = (PROFILE, "last")
"""Key of the profile that ran last."""
COOL_DOWN: Final = "cool_down"
CONTEXT: Final = ("context", "chosen")
"""Key of the context that was chosen by hand; the value is empty if none was."""
_SECOND: Final = 1_000_000_000


class SavedRequirement(msgspec.Struct, frozen=True, kw_only=True):
    """The requirement of one client, as it was received.

    Attributes:
        client: Name of the client's node.
        values: Attributes, ``priority`` and ``expires`` with their texts.
        mark: The message's mark, which responses repeat.
        stamp: The message's stamp, or empty; a latched message that arrives again has the same stamp.
        expires_ns: When it expires, in Unix nanoseconds of the wall clock, because the monotonic clock restarts with
            each boot; ``None``: never.
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
        """The parsed requirement; ``None`` if it has expired.

        Args:
            attributes: The resource's attributes, by name.
            resource: Name of the resource, for errors.
            now: Monotonic seconds.
            now_ns: The same moment by the wall clock, Unix nanoseconds.

        Raises:
            ConfigError: The texts are no valid requirement on the resource as it is declared now.
        """
        found = parse_requirement(self.client, list(self.values), attributes, resource, now)
        if self.expires_ns is None or found.expires is None:
            return replace(found, expires=None)
        if self.expires_ns <= now_ns:
            return None
        # If the wall clock was set back meanwhile, the requirement must not last longer than its whole duration.
        return replace(found, expires=min(found.expires, now + (self.expires_ns - now_ns) / _SECOND))


class SavedCoolDown(msgspec.Struct, frozen=True, kw_only=True):
    """The cool-down of a profile.

    Attributes:
        until_ns: End of the cool-down, in Unix nanoseconds of the wall clock.
        cool_down: Length of the cool-down in seconds.
        why: The reason, as a text for people.
    """

    until_ns: int
    cool_down: float
    why: str = ""

    def serialize(self) -> str:
        """As JSON."""
        return msgspec.json.encode(self).decode()

    def left(self, now: float, now_ns: int) -> CoolDown | None:
        """The rest of the cool-down, by the monotonic clock; ``None`` if it is over.

        If the wall clock was set back meanwhile, the whole cool-down is left; if it was set forward, it ends early.
        """
        left = min((self.until_ns - now_ns) / _SECOND, self.cool_down)
        return CoolDown(now + left, self.cool_down, self.why) if left > 0 else None


@dataclass(frozen=True, slots=True)
class SavedState:
    """The state that was saved before a restart.

    Args:
        parameters: The values of parameters that are still valid, by name.
        chosen: The profile chosen by hand, or empty.
        last: The profile that ran last, or empty.
        context: The context chosen by hand, or empty.
        requirements: Requirements that have not expired; their clients may come back.
        cool_downs: Cool-downs by profile.
        lost: A text about each row that is no longer valid.
    """

    parameters: Mapping[str, ParameterValue] = field(default_factory=dict, hash=False)
    chosen: str = ""
    last: str = ""
    context: str = ""
    requirements: Sequence[SavedRequirement] = ()
    cool_downs: Mapping[str, SavedCoolDown] = field(default_factory=dict, hash=False)
    lost: Sequence[str] = ()


def read_saved_state(rows: Mapping[Key, str], resource: Resource, now_ns: int) -> SavedState:
    """Read the rows of a store and check them against the present declaration of the resource.

    Args:
        rows: JSON texts by kind and name; untrusted, because any program may have written the file.
        resource: The resource, completely declared.
        now_ns: Unix nanoseconds of the wall clock.
    """
    parameters: dict[str, ParameterValue] = {}
    requirements: list[SavedRequirement] = []
    cool_downs: dict[str, SavedCoolDown] = {}
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
                    requirements.append(one)
            elif kind == COOL_DOWN:
                cool_downs[name] = _cool_down(resource, name, text)
            elif (kind, name) in chosen:
                chosen[kind, name] = _chosen(kind, text, resource)
        except (ConfigError, msgspec.DecodeError, RecursionError) as error:
            lost.append(f"{kind} {name}: {error}")
    return SavedState(
        parameters, chosen[CHOSEN], chosen[LAST], chosen[CONTEXT], tuple(requirements), cool_downs, tuple(lost)
    )


def _parameter(resource: Resource, name: str, text: str) -> ParameterValue:
    if name not in resource.parameters:
        raise ConfigError(f"parameter {name}", "it is declared no longer")
    value = msgspec.json.decode(text, type=bool | int | float | str)
    # JSON has one kind of number: 1.0 may come back as 1, which ``check`` converts.
    return resource.parameters[name].check(value)


def _cool_down(resource: Resource, name: str, text: str) -> SavedCoolDown:
    if name not in resource.profiles:
        raise ConfigError(f"profile {name}", "it is declared no longer")
    return msgspec.json.decode(text, type=SavedCoolDown)


def _chosen(kind: str, text: str, resource: Resource) -> str:
    name = msgspec.json.decode(text, type=str)
    if name and name not in (resource.profiles if kind == PROFILE else resource.contexts):
        raise ConfigError(f"{kind} {name}", "it is declared no longer")
    return name
