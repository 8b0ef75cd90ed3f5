"""What the settings say of peers: which topics and services cross, and how they are called at each end. Pure.

The context is frozen; when settings are read again it is replaced as a whole, and the parts judge again by it.

*Wire* names are those that cross: topics and services as the module has them that publishes or provides them. ::

    their graph   wire            our graph
    /odom  ─────► /odom  ──in───► /robot1/odom      prefix = "/robot1"
    /cmd_vel ◄─── /cmd_vel ◄─out─ /robot1/cmd_vel

The first rule that fits renames a name, once; the result is not renamed again. Only a relay offers the proxies of
other modules, and never to the module that they came from, so no rule can make a message loop.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Final

from rmpa.bridge.policy import OPEN_GATE, Policy, PolicyDecision, judge_globs
from rmpa.config import limits as config_limits
from rmpa.config.rules import CLOCK
from rmpa.config.settings import Settings
from rmpa.config.values import PEER
from rmpa.core.identity import ROSOUT, is_own, matches, matches_any

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from rmpa.bridge.policy import PermissionGate
    from rmpa.config.peer_rules import PeerRule, ServiceRule
    from rmpa.config.settings import ServiceSettings
    from rmpa.core.contract import Contracts, Transport


# Topics that have one name in all modules.
_FIXED: Final = (CLOCK, ROSOUT)


class PeerNames:
    """The names of one peer.

    Args:
        peer: The peer's name.
        rules: All ``[[peer]]`` tables, in the order of the file; those for other peers are ignored.

    Attributes:
        prefix: The prefix of the peer's names in the local graph, such as ``/robot1``, or empty.
    """

    def __init__(self, peer: str, rules: Iterable[PeerRule] = ()) -> None:
        mine = [rule for rule in rules if matches(rule.name, peer)]
        prefix = next((rule.prefix for rule in mine if rule.prefix), "").replace(PEER, peer)
        self._in = [_filled(each, peer) for rule in mine for each in rule.remap_in]
        self._out = [_filled(each, peer) for rule in mine for each in rule.remap_out]
        self.prefix: Final = prefix

    @property
    def plain(self) -> bool:
        """Whether no rule renames anything of this peer."""
        return not (self.prefix or self._in or self._out)

    def local_name(self, wire: str) -> str:
        """The local name of a peer's topic or service."""
        if wire in _FIXED:
            return wire  # nodes read the time, and the core the log, from no other topic
        renamed = (_renamed(wire, source, target) for source, target in self._in)
        return next((new for new in renamed if new is not None), self.prefix + wire)

    def wire_name(self, local: str) -> str:
        """The wire name, for this peer, of a local topic or service."""
        if local in _FIXED:
            return local
        renamed = (_renamed(local, source, target) for source, target in self._out)
        plain = local[len(self.prefix) :] if local.startswith(self.prefix + "/") else local
        return next((new for new in renamed if new is not None), plain)

    def wires_of(self, local: str) -> tuple[str, ...]:
        """The wire names that become this local name, best first."""
        names = [old for source, target in self._in if (old := _renamed(local, target, source)) is not None]
        names.append(local if not self.prefix else local.removeprefix(self.prefix))
        return tuple(n for n in dict.fromkeys(names) if n and self.local_name(n) == local)

    def locals_of(self, wire: str) -> tuple[str, ...]:
        """The local names that become this wire name, best first."""
        names = [old for source, target in self._out if (old := _renamed(wire, target, source)) is not None]
        names += [self.prefix + wire, wire]
        return tuple(n for n in dict.fromkeys(names) if self.wire_name(n) == wire)


class Names:
    """The names of all peers; one immutable set of rules for all parts, replaced when the rules change.

    Args:
        rules: All ``[[peer]]`` tables, in the order of the file.

    Attributes:
        of: ``(peer)``: the names of one peer, by the peer's name.
    """

    def __init__(self, rules: tuple[PeerRule, ...] = ()) -> None:
        self.of = lru_cache(config_limits.NAMES_REMEMBERED)(lambda peer: PeerNames(peer, rules))


def _filled(renaming: tuple[str, str], peer: str) -> tuple[str, str]:
    source, target = renaming
    return source.replace(PEER, peer), target.replace(PEER, peer)


def _renamed(name: str, source: str, target: str) -> str | None:
    """The name as one rule renames it, or with the two exchanged, undoes it; ``None`` if the rule does not fit."""
    if not source.endswith("/**"):
        return target if name == source else None
    stem = source[:-3]
    if name != stem and not name.startswith(stem + "/"):
        return None
    return target[:-3] + name[len(stem) :] or None


OWN_SERVICES: Final = "/rmpa/**"
# Every node has these two services; if they crossed, they would double the graph for no use.
LOGGERS: Final = ("**/get_loggers", "**/set_logger_level")


class ServiceRules:
    """Judges services, and says how they are called; the rules of topics do not apply to them.

    Args:
        settings: ``[services]`` and ``[[service]]``.
    """

    def __init__(self, settings: ServiceSettings) -> None:
        self._settings = settings

    def judge(self, service: str, node: str) -> PolicyDecision:
        """Decide whether a service may cross at all.

        The built-in rules go first, then ``services.deny``, then ``services.allow``; what no glob fits may not cross.

        Args:
            service: Its name in the local graph.
            node: The node that provides it.
        """
        settings = self._settings
        if is_own(node):
            return PolicyDecision(False, f"{node} stands for a node of another module, or is the agent itself")
        if matches(OWN_SERVICES, service):
            return PolicyDecision(False, "built in: the agent's own services do not cross")
        if not settings.loggers and matches_any(LOGGERS, service):
            return PolicyDecision(
                False, "built in: a node's log is set at home; services.loggers = true lets it cross"
            )
        return judge_globs(settings, "services", service)

    def timeout(self, service: str) -> float:
        """The time-out of a call of a service, in seconds.

        It is that of the first ``[[service]]`` that fits the service's name and says one, else that of
        ``[services]``.
        """
        said = (rule.timeout for rule in self._fitting(service) if rule.timeout is not None)
        return next(said, self._settings.timeout)

    def has_timeout(self, service: str) -> bool:
        """Whether a service has another time-out than the built-in one.

        Only agents keep time-outs: a call from node to node has none.
        """
        return self.timeout(service) != config_limits.SERVICE_TIMEOUT

    def transport(self, service: str) -> Transport:
        """The path of a service's calls that this module wants.

        It is that of the first ``[[service]]`` that fits the service's name and says one, else that of
        ``[services]``.
        """
        said = (rule.transport for rule in self._fitting(service) if rule.transport is not None)
        return next(said, self._settings.transport)

    def _fitting(self, service: str) -> Iterator[ServiceRule]:
        """The rules ``[[service]]`` that fit a service, in order."""
        return (rule for rule in self._settings.rules if matches_any(rule.names, service))


@dataclass(frozen=True, slots=True)
class BridgeContext:
    """The rules of one reading of the settings; made by ``of``.

    Args:
        settings: The settings that they come from.
        policy: Which topics may cross.
        services: Which services may cross, with their time-outs.
        names: Renames what crosses, for each peer.
        contracts: The contracts of this module's topics.
        gate: What each peer may do here.
    """

    settings: Settings
    policy: Policy
    services: ServiceRules
    names: Names
    contracts: Contracts
    gate: PermissionGate

    @classmethod
    def of(cls, settings: Settings | None = None, gate: PermissionGate = OPEN_GATE) -> BridgeContext:
        """The rules of these settings; without any, those of a module that sets nothing."""
        settings = settings if settings is not None else Settings()
        policy = Policy(settings.policy, settings.peers, settings.time, rosout=settings.rosout)
        names, services = Names(settings.naming), ServiceRules(settings.services)
        return cls(settings, policy, services, names, settings.make_contracts(), gate)

    def limit(self, kind: str) -> int:
        """The most ``topics`` or ``services`` of a module that cross."""
        return self.settings.limits.topics if kind == "topics" else self.settings.limits.services
