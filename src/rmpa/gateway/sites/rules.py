"""What may cross between this site and others, and its name here: a pure table that names the rule that decided."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.config.peer_rules import Access
from rmpa.config.rules import ROS2, Crossing
from rmpa.core.identity import is_global_name, matches
from rmpa.gateway.neighbour import SourceKind

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from rmpa.bridge.policy import PolicyDecision
    from rmpa.config.rules import CrossingRule
    from rmpa.gateway.site_permissions import SitePermissions

    Judge = Callable[[SourceKind, str, str, str], PolicyDecision]

_OUT: Final = (Crossing.BOTH, Crossing.OUT)
_IN: Final = (Crossing.BOTH, Crossing.IN)
_EVERY_SITE: Final = ("*", "**")
_NO_RULE: Final = "no gateway.rule fits: everything crosses"


@dataclass(frozen=True, slots=True)
class CrossingDecision:
    """Whether a source may cross, and how.

    Args:
        allowed: Whether it may.
        why: The rule that decided, as text.
        name: The name here of what comes in; empty if it may not cross.
        rate: Messages a second of what goes out; ``None``: no limit.
        size: Bytes a second of what goes out; ``None``: no limit.
        addressed: Whether what goes out does not go to all other sites alike: ``outgoing_to`` decides for each.
    """

    allowed: bool
    why: str
    name: str = ""
    rate: float | None = None
    size: int | None = None
    addressed: bool = False


class CrossingRules:
    """Judges sources by ``[[gateway.rule]]``: the first rule that fits holds; without one everything crosses.

    Args:
        rules: In the order of the file.
        judge: The gateway's own policy, ``(kind, name, type, node)``, which must let a source cross too: by its name
            in its module if it goes out, by its name here if it comes in. ``None``: it lets everything cross.
        permissions: ``[[permission]]``, which must let other sites do it too; what they refuse is counted. ``None``:
            trust is off.
    """

    def __init__(
        self,
        rules: Sequence[CrossingRule] = (),
        judge: Judge | None = None,
        permissions: SitePermissions | None = None,
    ) -> None:
        self._rules = tuple(rules)
        self._judge = judge
        self._permissions = permissions

    def outgoing(self, kind: SourceKind, module: str, name: str, type_name: str, node: str) -> CrossingDecision:
        """Decide whether a source of this site goes out to any other site, and whether to all of them alike.

        Args:
            kind: What it is.
            module: The module that has it.
            name: Its name in its module.
            type_name: Its type.
            node: Its node in its module.
        """
        decision = self._policy(kind, name, type_name, node)
        if not decision.allowed:
            return decision
        found = []
        for number, rule in self._fitting(module, name):
            if all(site == ROS2 for site in rule.sites):
                continue  # it is about no site
            found.append(_outgoing(number, rule))
            if any(glob in _EVERY_SITE for glob in rule.sites):
                break
        else:
            found.append(decision)
        first = found[0]
        if all((each.allowed, each.rate, each.size) == (first.allowed, first.rate, first.size) for each in found):
            return first
        named = next(each for each in found if each.allowed)
        return CrossingDecision(True, named.why, addressed=True)

    def outgoing_to(self, site: str, module: str, name: str) -> CrossingDecision:
        """Decide whether a source that ``outgoing`` lets out goes to one other site; permissions are not asked.

        Args:
            site: The other site; empty for a program that names none.
            module: The module that has it.
            name: Its name in its module.
        """
        for number, rule in self._fitting(module, name):
            if any(matches(glob, site) for glob in rule.sites):
                return _outgoing(number, rule, site)
        return CrossingDecision(True, _NO_RULE)

    def refusal(
        self,
        site: str,
        module: str,
        name: str,
        access: Access = Access.SUBSCRIBE,
        askers: tuple[str, ...] = (),
        told: str | None = None,
    ) -> str:
        """Why another site may not have a source or parameter of this one; empty if it may.

        Args:
            site: The other site; empty for a program that names none.
            module: The module that has it.
            name: Its name in its module.
            access: What the other site would do with it.
            askers: The modules of the other site that ask, as it says.
            told: The name for the text, if ``name`` was found in what was asked for and may be a secret.
        """
        decision = self.outgoing_to(site, module, name)
        if not decision.allowed:
            return decision.why
        return self.denial(site, name, access, askers, told)

    def denial(
        self,
        site: str,
        name: str,
        access: Access,
        askers: tuple[str, ...] = (),
        told: str | None = None,
    ) -> str:
        """Why the permissions, without the rules, do not let another site have a name; empty if they do."""
        return "" if self._permissions is None else self._permissions.why_not(access, site, name, askers, told)

    def incoming(
        self, kind: SourceKind, site: str, module: str, name: str, type_name: str, node: str
    ) -> CrossingDecision:
        """Decide whether a source of another site is shown here, and under which name.

        Args:
            kind: What it is.
            site: The other site.
            module: The module that has it.
            name: Its name in its module.
            type_name: Its type.
            node: Its node in its module.
        """
        here, why = name, _NO_RULE
        for number, rule in self._fitting(module, name):
            if not any(matches(glob, site) for glob in rule.sites):
                continue
            why = _named(number, rule)
            if rule.crossing not in _IN:
                return CrossingDecision(False, f"{why} lets it not come in")
            here = rule.name.replace("{name}", name).replace("{site}", site).replace("{module}", module)
            break
        if not is_global_name(here):
            return CrossingDecision(False, f"{why} names it {here!r}, which is no global name of ROS")
        decision = self._policy(kind, here, type_name, node)
        if not decision.allowed:
            return decision
        access = Access.PUBLISH if kind is SourceKind.TOPIC else Access.SERVE
        if self._permissions is not None and not self._permissions.admits(access, site, module, here):
            return CrossingDecision(False, self._permissions.judge(access, site, module, here).rule)
        return CrossingDecision(True, why, here)

    def _fitting(self, module: str, name: str) -> Iterator[tuple[int, CrossingRule]]:
        for number, rule in enumerate(self._rules, 1):
            if any(matches(glob, name) for glob in rule.names) and any(
                matches(glob, module) for glob in rule.modules
            ):
                yield number, rule

    def _policy(self, kind: SourceKind, name: str, type_name: str, node: str) -> CrossingDecision:
        decision = None if self._judge is None else self._judge(kind, name, type_name, node)
        if decision is None or decision.allowed:
            return CrossingDecision(True, _NO_RULE)
        return CrossingDecision(False, decision.rule)


def _outgoing(number: int, rule: CrossingRule, site: str = "") -> CrossingDecision:
    """What one rule says of a source that it fits; ``site`` is named in the reason."""
    if rule.crossing in _OUT:
        return CrossingDecision(True, _named(number, rule), rate=rule.rate, size=rule.size)
    return CrossingDecision(False, f"{_named(number, rule)} lets it not go out{f' to {site}' if site else ''}")


def _named(number: int, rule: CrossingRule) -> str:
    return f"gateway.rule {number} ({rule.crossing}: {', '.join(rule.names)})"
