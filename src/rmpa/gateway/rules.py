"""What passes between the gateway's graph and its neighbours (other sites, ROS 2), and the rules for it.

The gateway is a peer of the mesh that relays. Its core has the proxies of the modules at its site, which are *mesh
sources*; a neighbour carries those out. What a neighbour brings in are *foreign sources*; they become proxies in the
same core, which the relay offers to the modules (``gateway.own_graph``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Final, Protocol

from rmpa.bridge.policy import OPEN_GATE, BridgeContext, PermissionGate
from rmpa.config.peer_rules import Access
from rmpa.config.rules import ROS2, Crossing, CrossingRule
from rmpa.core.identity import is_global_name, matches_any
from rmpa.trust.permissions import asker_name, refusal

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence


class SourceKind(StrEnum):
    """What a source is; the value is its chunk in the keys of sites."""

    TOPIC = "t"
    SERVICE = "s"


@dataclass(frozen=True, slots=True)
class MeshSource:
    """A topic of one publisher, or a service, that a module at this site has.

    Args:
        kind: What it is.
        module: The module's name.
        instance: The module's run, 32 hexadecimal digits.
        node: The node in the module's graph, ``/like/this``.
        name: The topic or service in the module's graph.
        type: ``package/Name``; ``*`` for a service whose server was not asked.
        here: The topic or service in the gateway's graph.
        proxy: The node in the gateway's graph.
    """

    kind: SourceKind
    module: str
    instance: str
    node: str
    name: str
    type: str
    here: str
    proxy: str


@dataclass(frozen=True, slots=True)
class ForeignSource:
    """A topic of one publisher, or a service, that a neighbour has.

    Args:
        kind: What it is.
        site: The site's name, or ``ros2``: its proxies are ``/rmpa/<site>/…``.
        module: The module at that site; empty where the neighbour has none.
        node: The node in the module's graph.
        name: The topic or service in the gateway's graph, after the rules for names.
        type: ``package/Name`` of ROS 1.
    """

    kind: SourceKind
    site: str
    module: str
    node: str
    name: str
    type: str


# Kind, name here, and node here.
SourceKey = tuple[SourceKind, str, str]


class Neighbour(Protocol):
    """One kind of neighbour, which the gateway starts and closes."""

    def start(self) -> None:
        """Begin, in the event loop: the graph and the session are there."""

    async def close(self) -> None:
        """Take back everything."""

    def report(self) -> dict[str, object]:
        """What ``rmpa site`` and the snapshot show of it, as JSON values."""


_EVERY_SITE: Final = ("*", "**")
_NO_RULE: Final = "no gateway.rule fits: everything crosses"
# Topics that each node of ROS 2 has; they do not cross unless a rule names them as they are.
PLUMBING: Final = frozenset(("/rosout", "/parameter_events"))
# What a module or a site must be allowed to have, or to be told of, a source.
ACCESS: Final = {SourceKind.TOPIC: Access.SUBSCRIBE, SourceKind.SERVICE: Access.CALL}


@dataclass(frozen=True, slots=True)
class CrossingDecision:
    """Whether a source may cross, and how.

    Args:
        allowed: Whether it may.
        why: The rule that decided, as text.
        name: The name here of what comes in; empty if it may not cross.
        rate: Messages a second of what goes out, or comes from ROS 2; ``None``: no limit.
        size: Bytes a second of it; ``None``: no limit.
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
        context: The gateway's own ``[bridge]`` and ``[services]``, which must let a source cross too: by its name in
            its module if it goes out, by its name here if it comes in. ``None``: they are not asked.
        gate: ``[[permission]]``, which must let other sites do it too, as ``PermissionGate.judge_site`` says: Zenoh
            proves which gateway is connected, but not which site or module a message is of. What it refuses is
            counted.
    """

    def __init__(
        self,
        rules: Sequence[CrossingRule] = (),
        context: BridgeContext | None = None,
        gate: PermissionGate = OPEN_GATE,
    ) -> None:
        self._rules = tuple(enumerate(rules, 1))
        self._context = context
        self._gate = gate

    def outgoing(self, source: MeshSource) -> CrossingDecision:
        """Decide whether a source of this site goes out to any other site, and whether to all of them alike.

        Permissions count: what they let no site have never leaves for the router.
        """
        if why := self._policy(source.kind, source.name, source.type, source.node):
            return CrossingDecision(False, why)
        found = []
        for number, rule in self._fitting(source.module, source.name):
            if all(site == ROS2 for site in rule.sites):
                continue  # it is about no site
            found.append(_outgoing(number, rule))
            if any(glob in _EVERY_SITE for glob in rule.sites):
                break
        else:
            found.append(CrossingDecision(True, _NO_RULE))
        alike = len({(each.allowed, each.rate, each.size) for each in found}) == 1
        why = next((each.why for each in found if each.allowed), "")
        decision = found[0] if alike else CrossingDecision(True, why, addressed=True)
        if not decision.allowed:
            return decision
        judged = self._gate.judge_all(ACCESS[source.kind], "any other site", source.name)
        if judged is None:
            return replace(decision, addressed=True)
        return decision if judged.allowed else CrossingDecision(False, judged.rule)

    def offered_to(self, site: str, source: MeshSource) -> CrossingDecision:
        """Decide whether a source that ``outgoing`` addresses goes to one other site, by rules and permissions."""
        decision = self.outgoing_to(site, source.module, source.name)
        judged = self._gate.judge(ACCESS[source.kind], site, source.name)
        return decision if judged.allowed or not decision.allowed else CrossingDecision(False, judged.rule)

    def outgoing_to(self, site: str, module: str, name: str) -> CrossingDecision:
        """Decide whether a source that ``outgoing`` lets out goes to one other site; permissions are not asked.

        Args:
            site: The other site; empty for a program that names none.
            module: The module that has it.
            name: Its name in its module.
        """
        found = next(self._fitting(module, name, site), None)
        return CrossingDecision(True, _NO_RULE) if found is None else _outgoing(*found, site)

    def refusal(
        self,
        site: str,
        module: str,
        name: str,
        access: Access = Access.SUBSCRIBE,
    ) -> str:
        """Why another site may not have a source of this one; empty if it may.

        Args:
            site: The other site; empty for a program that names none.
            module: The module that has it.
            name: Its name in its module.
            access: What the other site would do with it.
        """
        decision = self.outgoing_to(site, module, name)
        return self.denial(site, name, access) if decision.allowed else decision.why

    @property
    def secured(self) -> bool:
        """Whether ``[[permission]]`` holds."""
        return self._gate.on

    def tells(self, asker: str, kind: SourceKind, name: str) -> bool:
        """Whether a module of this site may have, and be told of, what has this name here.

        Args:
            asker: The module; empty for this machine's user.
            kind: What it is.
            name: The topic or service.
        """
        return not asker or self._gate.judge(ACCESS[kind], asker, name).allowed

    def denial(self, site: str, name: str, access: Access) -> str:
        """Why permissions, without the rules, do not let another site, or a module, have a name; empty if they do."""
        decision = self._gate.judge(access, site, name)
        if decision.allowed:
            return ""
        self._gate.refused(access, site, name, decision)
        return refusal(access, site, name)

    def incoming(self, source: ForeignSource) -> CrossingDecision:
        """Decide whether a source of another site or of ROS 2 is shown here, and under which name.

        Args:
            source: The source by its name there.
        """
        site, module, here, why = source.site, source.module or source.site, source.name, _NO_RULE
        rate = size = None
        if site == ROS2 and here in PLUMBING and not any(here in rule.names for _, rule in self._rules):
            return CrossingDecision(
                False, f"{here} is of each ROS 2 node; a gateway.rule that names it lets it cross"
            )
        if (found := next(self._fitting(module, here, site), None)) is not None:
            number, rule = found
            why = _named(number, rule)
            if rule.crossing not in (Crossing.BOTH, Crossing.IN):
                return CrossingDecision(False, f"{why} lets it not come in")
            if site == ROS2:  # what comes from another site was limited there
                rate, size = rule.rate, rule.size
            here = rule.name.replace("{name}", here).replace("{site}", site).replace("{module}", module)
        if not is_global_name(here):
            return CrossingDecision(False, f"{why} names it {here!r}, which is no global name of ROS")
        if refused := self._policy(source.kind, here, source.type, source.node):
            return CrossingDecision(False, refused)
        access = Access.PUBLISH if source.kind is SourceKind.TOPIC else Access.SERVE
        judged = self._gate.judge_site(access, site, (source.module,) if source.module else (), here)
        if not judged.allowed:
            self._gate.refused(access, site, here, judged)
            return CrossingDecision(False, judged.rule)
        return CrossingDecision(True, why, here, rate, size)

    def _fitting(self, module: str, name: str, site: str | None = None) -> Iterator[tuple[int, CrossingRule]]:
        for number, rule in self._rules:
            if (
                matches_any(rule.names, name)
                and matches_any(rule.modules, module)
                and (site is None or matches_any(rule.sites, site))
            ):
                yield number, rule

    def _policy(self, kind: SourceKind, name: str, type_name: str, node: str) -> str:
        """Why the gateway's own policy does not let a source cross; empty if it does."""
        if self._context is None:
            return ""
        if kind is SourceKind.SERVICE:
            decision = self._context.services.judge(name, node)
        else:
            decision = self._context.policy.judge(name, type_name, node)
        return "" if decision.allowed else decision.rule


def _outgoing(number: int, rule: CrossingRule, site: str | None = None) -> CrossingDecision:
    """What one rule says of a source that it fits; the ``site`` that asks, if one does, is named in the reason."""
    if rule.crossing in (Crossing.BOTH, Crossing.OUT):
        return CrossingDecision(True, _named(number, rule), rate=rule.rate, size=rule.size)
    return CrossingDecision(
        False, f"{_named(number, rule)} lets it not go out{'' if site is None else f' to {asker_name(site)}'}"
    )


def _named(number: int, rule: CrossingRule) -> str:
    return f"gateway.rule {number} ({rule.crossing}: {', '.join(rule.names)})"
