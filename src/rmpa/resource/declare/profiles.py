"""System Profiles: configurations of a resource, each with the quality that it offers (paper, section 3.1)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rmpa.core.errors import ConfigError
from rmpa.resource.declare.requirements import find_attribute

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rmpa.resource.declare.attributes import Attribute, Value


@dataclass(frozen=True, slots=True)
class Profile:
    """One System Profile, as a resource declares it.

    Args:
        name: Unique within the resource.
        offers: The offered value of each attribute, in the attribute's unit. An attribute that only other profiles
            offer falls short of every request.
        cost: At least 0, in any unit that all profiles share; decides among profiles of nearly equal distance.
        best_effort: Whether the profile runs when none meets the requirements; a resource has at most one such.
        description: A text for people.
    """

    name: str
    offers: Mapping[str, Value] = field(hash=False)
    cost: float = 0.0
    best_effort: bool = False
    description: str = ""


def check_profiles(profiles: Iterable[Profile], attributes: Mapping[str, Attribute], resource: str) -> None:
    """Check the profiles of a resource.

    Raises:
        ConfigError: A duplicate name, an undeclared attribute, an invalid value, a cost below 0, two best-effort
            profiles, or no profile at all.
    """
    seen: set[str] = set()
    best = ""
    for profile in profiles:
        where = f"profile {profile.name} of {resource}"
        if profile.name in seen:
            raise ConfigError(where, "there are two of this name", "name one of them otherwise")
        seen.add(profile.name)
        if not (math.isfinite(profile.cost) and profile.cost >= 0):
            raise ConfigError(where, f"a cost of {profile.cost:g}", "it is at least 0")
        if profile.best_effort and best:
            raise ConfigError(where, f"{best} is the best-effort profile already", "mark one of them only")
        best = profile.name if profile.best_effort else best
        for name, value in profile.offers.items():
            find_attribute(attributes, name, resource).check(value, f"{where}, {name}")
    if not seen:
        raise ConfigError(resource, "it has no profile", "declare at least one")
