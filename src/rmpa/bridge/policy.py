"""What may cross the mesh: a pure table of rules that can say which of them decided."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from rmpa.config import limits
from rmpa.config.param_rules import CLOCK
from rmpa.config.peer_rules import PEER
from rmpa.config.settings import TimeSettings
from rmpa.core.names import NEVER_CROSSING, matches

if TYPE_CHECKING:
    from rmpa.config.settings import PeerRule, PolicySettings

OWN_NODE: Final = "/rmpa"
"""The agent's own node; what it stands for lives below: ``/rmpa/<peer>/<node>``."""

BUILT_IN_DENY: Final = NEVER_CROSSING
"""Topics that never cross, and why."""


_NO_TIME: Final = TimeSettings()


@dataclass(frozen=True, slots=True)
class PolicyDecision:
    """Whether a source may cross, and the rule that says so, ready to show."""

    allowed: bool
    rule: str


def is_own(node: str) -> bool:
    """Whether a local node is the agent itself or stands for a node of another module."""
    return node == OWN_NODE or node.startswith(OWN_NODE + "/")


class Policy:
    """Judges sources by their topic, type and node.

    Args:
        settings: The user's globs for all peers.
        peers: And those for single ones, on top.
        time: Whether ``/clock`` crosses, and from which peer: nothing else decides about that.
    """

    def __init__(
        self, settings: PolicySettings, peers: tuple[PeerRule, ...] = (), time: TimeSettings = _NO_TIME
    ) -> None:
        self._settings = settings
        self._peers = peers
        self._time = time
        self._known: dict[str, list[tuple[str, PolicySettings]]] = {}

    def judge(self, topic: str, type_name: str, node: str) -> PolicyDecision:
        """Decide about one source; the first "no" wins, in the order of the table below."""
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
        """Whether ``judge_for`` has anything to say about a peer."""
        return bool(self._rules_for(peer))

    def _rules_for(self, peer: str) -> list[tuple[str, PolicySettings]]:
        """What is said about a peer: its place in the file, to show, and the globs with its name filled in."""
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
        """Decide whether what ``judge`` lets cross may do so between us and one peer.

        Args:
            peer: The peer's name.
            name: What it is here: a topic or a service.
            type_name: A topic's message type; ``None`` where there is none to judge by.
            wire: What it is called on its way, where that is another name.
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
    """Why a topic never crosses, or empty."""
    return next((why for pattern, why in BUILT_IN_DENY.items() if matches(pattern, topic)), "")


def _filled(settings: PolicySettings, peer: str) -> PolicySettings:
    allow, deny = (tuple(glob.replace(PEER, peer) for glob in globs) for globs in (settings.allow, settings.deny))
    return replace(settings, allow=allow, deny=deny)


def _judge(settings: PolicySettings, where: str, name: str, type_name: str | None) -> PolicyDecision:
    """Decide by one set of globs; ``where`` is its place in the file, to show."""
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
