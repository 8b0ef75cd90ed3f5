"""Which services may cross, what they are called on their way, and how long a call may take: one pure value."""

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
"""Every node has these two; across modules they would double the graph for nothing."""


class ServiceRules:
    """Judges and names services.

    Args:
        settings: ``[services]`` and ``[[service]]``.
        policy: For what ``[[peer]]`` allows; topics' own rules do not touch services.
        names: For what ``[[peer]]`` renames.
    """

    def __init__(self, settings: ServiceSettings, policy: Policy, names: Names | None = None) -> None:
        self._settings = settings
        self._policy = policy
        self._names = names if names is not None else Names()

    def judge(self, service: str, node: str) -> PolicyDecision:
        """Decide about one service, by its name here and its node; the first "no" wins."""
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
        """Decide whether what ``judge`` lets cross may do so between us and one peer."""
        return self._policy.judge_for(peer, service, wire=wire)

    def local_name(self, peer: str, wire: str) -> str:
        """What a peer's service is called here."""
        return self._names.local_name(peer, wire)

    def wire_name(self, peer: str, service: str) -> str:
        """What a service of ours is called on the way to a peer."""
        return self._names.wire_name(peer, service)

    def timeout(self, service: str) -> float:
        """Seconds that a call of a service may take: what the first ``[[service]]`` that fits says."""
        for rule in self._settings.rules:
            if any(matches(pattern, service) for pattern in rule.names):
                return rule.timeout
        return self._settings.timeout
