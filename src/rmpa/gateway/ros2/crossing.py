"""Which sources cross between the mesh and ROS 2, and under which names, by ``[[gateway.rule]]``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rmpa.gateway.neighbour import SourceKind
from rmpa.gateway.sites.rules import CrossingDecision, CrossingRules

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rmpa.config.rules import CrossingRule

SITE: Final = "ros2"
"""The name of ROS 2 among the sites, in rules and in the names of proxies; it is ``{module}`` too."""
PLUMBING: Final = frozenset(("/rosout", "/parameter_events"))
"""Topics that each node of ROS 2 has; they do not cross unless a rule names them as they are."""


class Ros2Crossing:
    """Judges sources by the rules; the first that fits holds, and without one everything crosses.

    Args:
        rules: The tables ``[[gateway.rule]]``, in order.
    """

    def __init__(self, rules: Sequence[CrossingRule] = ()) -> None:
        self._rules = tuple(rules)
        self._crossing = CrossingRules(rules)

    def outgoing(self, module: str, name: str) -> CrossingDecision:
        """Decide whether a source of a module crosses to ROS 2, by its name in its module."""
        return self._crossing.outgoing_to(SITE, module, name)

    def incoming(self, kind: SourceKind, name: str, type_name: str, node: str) -> CrossingDecision:
        """Decide whether a topic or service of ROS 2 is shown here, and under which name."""
        if name in PLUMBING and not any(name in rule.names for rule in self._rules):
            return CrossingDecision(
                False, f"{name} is of each ROS 2 node; a gateway.rule that names it lets it cross"
            )
        return self._crossing.incoming(kind, SITE, SITE, name, type_name, node)

    def name_here(self, name: str) -> str | None:
        """The name here of a service of ROS 2; ``None`` if it does not cross."""
        decision = self.incoming(SourceKind.SERVICE, name, "*", "")
        return decision.name if decision.allowed else None
