"""Decides what may cross the mesh, by a pure table of rules, and names the rule that decided."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from rmpa.config import limits
from rmpa.config.peer_rules import PEER
from rmpa.config.rules import CLOCK
from rmpa.config.settings import TimeSettings
from rmpa.core.identity import NEVER_CROSSING, matches

if TYPE_CHECKING:
    from rmpa.config.settings import PeerRule, PolicySettings

OWN_NODE: Final = "/rmpa"
"""The agent's own node; proxies have names below it: ``/rmpa/<peer>/<node>``."""

BUILT_IN_DENY: Final = NEVER_CROSSING
"""Topics that never cross, each with the reason."""


_NO_TIME: Final = TimeSettings()


@dataclass(frozen=True, slots=True)
class PolicyDecision:
    """Whether a source may cross, and the rule that decided, as text."""

    allowed: bool
    rule: str


def is_own(node: str) -> bool:
    """Whether a local node is the agent's own or a proxy."""
    return node == OWN_NODE or node.startswith(OWN_NODE + "/")


class Policy:
    """Judges sources by their topic, type and node.

    Args:
        settings: The user's globs for all peers.
        peers: Additional globs for single peers.
        time: Whether ``/clock`` crosses, and from which peer it is taken.
    """

    def __init__(
        self, settings: PolicySettings, peers: tuple[PeerRule, ...] = (), time: TimeSettings = _NO_TIME
    ) -> None:
        self._settings = settings
        self._peers = peers
        self._time = time
        self._known: dict[str, list[tuple[str, PolicySettings]]] = {}

    def judge(self, topic: str, type_name: str, node: str) -> PolicyDecision:
        """Decide about one source by the rules for all peers; a refusal wins over an ``allow``."""
        if is_own(node):
            return PolicyDecision(False, f"{node} stands for a node of another module, or is the agent itself")
        if topic == CLOCK and self._time.share:
            return PolicyDecision(True, "time.share = true: peers may follow this module's time")
        if why := never_crosses(topic):
            return PolicyDecision(False, f"built in: {why}")
        return _judge(self._settings, "bridge", topic, type_name)

    def judge_clock(self, peer: str) -> PolicyDecision:
        """Decide whether a peer's ``/clock`` may come here."""
        if not self._time.follow:
            return PolicyDecision(False, f"built in: {NEVER_CROSSING[CLOCK]}; [time] follow names the peer to follow")
        if self._time.follow != peer:
            return PolicyDecision(False, f'time.follow = "{self._time.follow}": time comes from there alone')
        return PolicyDecision(True, f'time.follow = "{peer}"')

    def has_rules_for(self, peer: str) -> bool:
        """Whether there are globs for this peer."""
        return bool(self._rules_for(peer))

    def _rules_for(self, peer: str) -> list[tuple[str, PolicySettings]]:
        """The rules for a peer: the place of each in the file, as text, and its globs with the name filled in."""
        known = self._known.get(peer)
        if known is None:
            if len(self._known) >= limits.NAMES_REMEMBERED:
                self._known.clear()
            known = self._known[peer] = [
                (f'peer "{rule.name}"', _filled(rule.policy, peer))
                for rule in self._peers
                if matches(rule.name, peer)
            ]
        return known

    def judge_for(self, peer: str, name: str, type_name: str | None = None, wire: str = "") -> PolicyDecision:
        """Decide whether a source that ``judge`` allows may cross between this module and one peer.

        Args:
            peer: The peer's name.
            name: The local name of the topic or service.
            type_name: A topic's message type; ``None`` for a service, or if the type is unknown.
            wire: The wire name, if it differs.
        """
        decision = PolicyDecision(True, "")
        if wire and wire != name and (why := never_crosses(wire)):
            return PolicyDecision(False, f"built in: {why} (it is {wire} there)")
        for where, settings in self._rules_for(peer):
            decision = _judge(settings, where, name, type_name)
            if not decision.allowed:
                return decision
        return decision


def never_crosses(topic: str) -> str:
    """The reason why a topic never crosses, or empty."""
    return next((why for pattern, why in BUILT_IN_DENY.items() if matches(pattern, topic)), "")


def _filled(settings: PolicySettings, peer: str) -> PolicySettings:
    allow, deny = (tuple(glob.replace(PEER, peer) for glob in globs) for globs in (settings.allow, settings.deny))
    return replace(settings, allow=allow, deny=deny)


def _judge(settings: PolicySettings, where: str, name: str, type_name: str | None) -> PolicyDecision:
    """Decides by one set of globs; ``where`` is its place in the file, as text."""
    for pattern in settings.deny:
        if matches(pattern, name):
            return PolicyDecision(False, f"{where}.deny has {pattern!r}")
    if type_name is not None:
        for pattern in settings.deny_types:
            if matches(pattern, type_name):
                return PolicyDecision(False, f"{where}.deny_types has {pattern!r}")
        if not any(matches(pattern, type_name) for pattern in settings.allow_types):
            return PolicyDecision(False, f"no glob of {where}.allow_types fits {type_name}")
    for pattern in settings.allow:
        if matches(pattern, name):
            return PolicyDecision(True, f"{where}.allow has {pattern!r}")
    return PolicyDecision(False, f"no glob of {where}.allow fits {name}")
