"""Which sources cross between the mesh and ROS 2, and under which names, by ``[[gateway.rule]]``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rmpa.config.gateway_rules import Crossing, CrossingRule
from rmpa.core.names import matches

if TYPE_CHECKING:
    from collections.abc import Sequence

SITE: Final = "ros2"
"""The name of ROS 2 among the sites, in rules and in the names of proxies."""
_NO_RULE: Final = CrossingRule()


class Ros2Crossing:
    """Judges sources by the rules; the first that fits holds, and without one everything crosses.

    Args:
        rules: The tables ``[[gateway.rule]]``, in order.
    """

    def __init__(self, rules: Sequence[CrossingRule]) -> None:
        self._rules = tuple(rule for rule in rules if any(matches(glob, SITE) for glob in rule.sites))

    def goes_out(self, module: str, name: str) -> bool:
        """Whether a source of a module at this site may cross to ROS 2; ``name`` is the one in its module."""
        return self.rule(module, name).crossing in (Crossing.BOTH, Crossing.OUT)

    def name_here(self, name: str) -> str | None:
        """The name here of a topic or service of ROS 2; ``None`` if it may not cross."""
        rule = self.rule("", name)
        if rule.crossing not in (Crossing.BOTH, Crossing.IN):
            return None
        made = rule.name.replace("{site}", SITE).replace("{module}", SITE).replace("{name}", name)
        return "/" + "/".join(part for part in made.split("/") if part)

    def rule(self, module: str, name: str) -> CrossingRule:
        """The rule that holds for a source; ROS 2's sources have no module, which only the glob ``*`` fits."""
        for rule in self._rules:
            fits_module = any(glob in ("*", "**") or (module and matches(glob, module)) for glob in rule.modules)
            if fits_module and any(matches(glob, name) for glob in rule.names):
                return rule
        return _NO_RULE
