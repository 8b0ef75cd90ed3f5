"""Which services may cross, their names at a peer and here, and the time-out of a call. Without I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rmpa.bridge.naming import Names
from rmpa.bridge.policy import PolicyDecision, is_own
from rmpa.core.names import matches

if TYPE_CHECKING:
    from rmpa.bridge.policy import Policy
    from rmpa.config.settings import ServiceSettings

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

    def timeout(self, service: str) -> float:
        """The time-out of a call of a service, in seconds.

        It is that of the first ``[[service]]`` that fits the service's name, else that of ``[services]``.
        """
        for rule in self._settings.rules:
            if any(matches(pattern, service) for pattern in rule.names):
                return rule.timeout
        return self._settings.timeout
