"""Which sources cross between the mesh and ROS 2, and under which names, by ``[[gateway.rule]]``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rmpa.config.gateway_rules import Crossing
from rmpa.core.names import matches
from rmpa.gateway.neighbour import SourceKind
from rmpa.gateway.sites.rules import CrossingDecision, CrossingRules

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rmpa.config.gateway_rules import CrossingRule
    from rmpa.gateway.sites.rules import Judge

SITE: Final = "ros2"
"""The name of ROS 2 among the sites, in rules and in the names of proxies; it is ``{module}`` too."""
PLUMBING: Final = frozenset(("/rosout", "/parameter_events"))
"""Topics that each node of ROS 2 has; they do not cross unless a rule names them as they are."""


class Ros2Crossing:
    """Judges sources by the rules; the first that fits holds, and without one everything crosses.

    Args:
        rules: The tables ``[[gateway.rule]]``, in order.
        judge: The gateway's own policy, which must let a source cross too; ``None``: it lets everything cross.
    """

    def __init__(self, rules: Sequence[CrossingRule] = (), judge: Judge | None = None) -> None:
        self._rules = tuple(rules)
        self._judge = judge
        self._incoming = CrossingRules(rules, judge)

    def outgoing(self, kind: SourceKind, module: str, name: str, type_name: str, node: str) -> CrossingDecision:
        """Decide whether a source of a module crosses to ROS 2; all names are those in its module."""
        decision = None if self._judge is None else self._judge(kind, name, type_name, node)
        if decision is not None and not decision.allowed:
            return CrossingDecision(False, decision.rule)
        for number, rule in enumerate(self._rules, 1):
            globs = ((rule.names, name), (rule.sites, SITE), (rule.modules, module))
            if all(any(matches(glob, value) for glob in given) for given, value in globs):
                why = f"gateway.rule {number} ({rule.crossing}: {', '.join(rule.names)})"
                if rule.crossing not in (Crossing.BOTH, Crossing.OUT):
                    return CrossingDecision(False, f"{why} lets it not go out to {SITE}")
                return CrossingDecision(True, why, name, rule.rate, rule.size)
        return CrossingDecision(True, "no gateway.rule fits: everything crosses", name)

    def incoming(self, kind: SourceKind, name: str, type_name: str, node: str) -> CrossingDecision:
        """Decide whether a topic or service of ROS 2 is shown here, and under which name."""
        if name in PLUMBING and not any(name in rule.names for rule in self._rules):
            return CrossingDecision(
                False, f"{name} is of each ROS 2 node; a gateway.rule that names it lets it cross"
            )
        return self._incoming.incoming(kind, SITE, SITE, name, type_name, node)

    def goes_out(self, module: str, name: str) -> bool:
        """Whether a service of a module crosses to ROS 2; ``name`` is the one in its module."""
        return self.outgoing(SourceKind.SERVICE, module, name, "*", "").allowed

    def name_here(self, name: str) -> str | None:
        """The name here of a service of ROS 2; ``None`` if it does not cross."""
        decision = self.incoming(SourceKind.SERVICE, name, "*", "")
        return decision.name if decision.allowed else None
