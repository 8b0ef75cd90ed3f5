"""State that survives a restart: parameters, choices by hand, the last profile, requirements and cool-downs."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import msgspec

from rmpa.core.errors import ConfigError
from rmpa.resource.decide.cool_downs import CoolDown
from rmpa.resource.declare.requirement_text import parse_requirement

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.resource.declare.attributes import Attribute
    from rmpa.resource.declare.requirements import Requirement
    from rmpa.resource.declare.resource import Resource

_SECOND = 1_000_000_000


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

    def left(self, now: float, now_ns: int) -> CoolDown | None:
        """The rest of the cool-down, by the monotonic clock; ``None`` if it is over.

        If the wall clock was set back meanwhile, the whole cool-down is left; if it was set forward, it ends early.
        """
        left = min((self.until_ns - now_ns) / _SECOND, self.cool_down)
        return CoolDown(now + left, self.cool_down, self.why) if left > 0 else None


class SavedState(msgspec.Struct, frozen=True, kw_only=True):
    """The state of a resource, as its file has it (JSON).

    Attributes:
        parameters: The values of parameters that differ from their defaults, by name.
        chosen: The profile chosen by hand, or empty.
        last: The profile that ran last, or empty.
        context: The context chosen by hand, or empty.
        requirements: Requirements of clients, which may come back.
        cool_downs: Cool-downs by profile.
    """

    parameters: dict[str, bool | int | float | str] = {}
    chosen: str = ""
    last: str = ""
    context: str = ""
    requirements: tuple[SavedRequirement, ...] = ()
    cool_downs: dict[str, SavedCoolDown] = {}

    def checked(self, resource: Resource, now_ns: int) -> tuple[SavedState, list[str]]:
        """What still fits the declaration of the resource, and a text about each part that does not.

        Args:
            resource: The resource, completely declared.
            now_ns: Unix nanoseconds of the wall clock.
        """
        lost: list[str] = []
        parameters, requirements = {}, []
        for name, value in self.parameters.items():
            try:
                if _declared("parameter", name, resource.parameters, lost):
                    parameters[name] = resource.parameters[name].check(value)
            except ConfigError as error:
                lost.append(str(error))
        for one in self.requirements:
            try:
                if one.requirement(resource.attributes, resource.name, 0.0, now_ns) is not None:
                    requirements.append(one)
            except ConfigError as error:
                lost.append(f"requirement of {one.client}: {error}")
        found = SavedState(
            parameters=parameters,
            chosen=_declared("profile", self.chosen, resource.profiles, lost),
            last=_declared("profile", self.last, resource.profiles, lost),
            context=_declared("context", self.context, resource.contexts, lost),
            requirements=tuple(requirements),
            cool_downs={n: c for n, c in self.cool_downs.items() if _declared("profile", n, resource.profiles, lost)},
        )
        return found, lost


def _declared(kind: str, name: str, known: Mapping[str, object], lost: list[str]) -> str:
    """The name, or an empty one if it is declared no longer."""
    if not name or name in known:
        return name
    lost.append(f"{kind} {name}: it is declared no longer")
    return ""
