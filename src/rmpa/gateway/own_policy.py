"""The gateway's own policy of what crosses, by its ``[bridge]`` and ``[services]``, for topics and services alike."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.bridge.policy import Policy
from rmpa.bridge.proxies import Names
from rmpa.bridge.services.exports import ServiceRules
from rmpa.gateway.neighbour import SourceKind

if TYPE_CHECKING:
    from rmpa.bridge.policy import PolicyDecision
    from rmpa.config.settings import Settings


class OwnPolicy:
    """Judges what comes in from a neighbour or goes out to it, as an agent judges what comes from a peer.

    Args:
        settings: The gateway's.
    """

    def __init__(self, settings: Settings) -> None:
        self._topics = Policy(settings.policy, settings.peers, settings.time)
        self._services = ServiceRules(settings.services, self._topics, Names(settings.naming))

    def judge(self, kind: SourceKind, name: str, type_name: str, node: str) -> PolicyDecision:
        """Decide whether a source may cross; ``type_name`` counts for topics alone."""
        if kind is SourceKind.SERVICE:
            return self._services.judge(name, node)
        return self._topics.judge(name, type_name, node)

    def timeout(self, service: str) -> float:
        """Seconds that a call of a service may take (``[[service]]``)."""
        return self._services.timeout(service)
