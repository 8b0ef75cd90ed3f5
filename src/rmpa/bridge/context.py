"""What the settings say of peers, and what all parts of the bridge share.

The context is frozen; when settings are read again it is replaced as a whole, and the parts judge again by it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.bridge.policy import OPEN_GATE, Policy, PolicyDecision
from rmpa.bridge.proxies import Names
from rmpa.config import limits as config_limits
from rmpa.config.settings import Settings
from rmpa.core.identity import is_own, matches

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.bridge.policy import PermissionGate, Relay
    from rmpa.bridge.rpc import PeerRpc
    from rmpa.bridge.sessions import PeerSessions
    from rmpa.config.settings import ServiceRule, ServiceSettings
    from rmpa.core.contract import Contracts, Transport
    from rmpa.core.counters import Counters
    from rmpa.ros.core.external import Core
    from rmpa.ros.node.slave_node import SlaveNode

OWN_SERVICES: Final = "/rmpa/**"
LOGGERS: Final = ("**/get_loggers", "**/set_logger_level")
"""Every node has these two services; if they crossed, they would double the graph for no use."""


class ServiceRules:
    """Judges and names services.

    Args:
        settings: ``[services]`` and ``[[service]]``.
        policy: For what ``[[peer]]`` allows; the rules of topics do not apply to services.
        names: For what ``[[peer]]`` renames.
    """

    def __init__(self, settings: ServiceSettings, policy: Policy, names: Names | None = None) -> None:
        self._settings = settings
        self._policy = policy
        self._names = names if names is not None else Names()

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
            return PolicyDecision(False, "built in: the agent's own services stay home")
        if not settings.loggers and any(matches(pattern, service) for pattern in LOGGERS):
            return PolicyDecision(
                False, "built in: a node's log is set at home; services.loggers = true lets it cross"
            )
        for pattern in settings.deny:
            if matches(pattern, service):
                return PolicyDecision(False, f"services.deny has {pattern!r}")
        for pattern in settings.allow:
            if matches(pattern, service):
                return PolicyDecision(True, f"services.allow has {pattern!r}")
        return PolicyDecision(False, f"no glob of services.allow fits {service}")

    def judge_for(self, peer: str, service: str, wire: str) -> PolicyDecision:
        """Decide whether a service that ``judge`` allows may cross between this module and one peer.

        Args:
            peer: The peer's name.
            service: The service's name in the local graph.
            wire: Its name on the wire.
        """
        return self._policy.judge_for(peer, service, wire=wire)

    def local_name(self, peer: str, wire: str) -> str:
        """The name in the local graph of a service that a peer offers as ``wire``."""
        return self._names.local_name(peer, wire)

    def wire_name(self, peer: str, service: str) -> str:
        """The name on the wire, to this peer, of a service of this module."""
        return self._names.wire_name(peer, service)

    def own_name(self, peer: str, wire: str) -> str:
        """The name in the local graph of a service of this module that this peer knows as ``wire``."""
        return next(iter(self._names.of(peer).locals_of(wire)), wire)

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
        return (rule for rule in self._settings.rules if any(matches(pattern, service) for pattern in rule.names))


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
        policy, names = Policy(settings.policy, settings.peers, settings.time), Names(settings.naming)
        services = ServiceRules(settings.services, policy, names)
        return cls(settings, policy, services, names, settings.make_contracts(), gate)


class Shared:
    """What all parts of a bridge share; ``Bridge`` makes it."""

    core: Core
    """The local core."""
    node: SlaveNode
    """The agent's own node in the local graph."""
    sessions: PeerSessions
    """The sessions of the peers."""
    rpc: PeerRpc
    """The requests and notifications to and from the peers."""
    relay: Relay
    """Which sources of one peer are offered to others."""
    counters: Counters
    """Counts what happens, by name."""
    rng: Callable[[], float]
    """Uniform numbers in [0, 1), for the jitter of a back-off."""
    context: BridgeContext
    """The rules that hold now; each reading of the settings makes another one."""
