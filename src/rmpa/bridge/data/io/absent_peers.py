"""Peers that have been away for longer than their routes wait, and the loss counts kept for their return."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from rmpa.bridge.permission_gate import OPEN_GATE, PermissionGate
from rmpa.mesh import limits

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.bridge.data.losses import ReceptionHistory
    from rmpa.bridge.messages import Source
    from rmpa.core.identity import Identity


@dataclass(frozen=True, slots=True)
class Absent:
    """A peer whose proxies were removed from the local graph.

    Args:
        peer: Its number, under which the outbound side counts the messages that it misses.
        identity: The run of the module.
        since: When its last link ended, monotonic seconds.
        pasts: The histories of its reliable sources.
        counted: Whether the outbound side still counts.
    """

    peer: int
    identity: Identity
    since: float
    pasts: dict[Source, ReceptionHistory]
    counted: bool = True


class AbsentPeers:
    """Up to ``limits.ABSENT_PEERS_MAX`` absent peers; the one that has been away longest is forgotten first.

    Args:
        uncount: Called with a peer's number when its missed messages are no longer counted.
        forget: Called with a peer's number when it is forgotten.
        gate: Whether the mesh is secured.
    """

    def __init__(
        self, uncount: Callable[[int], None], forget: Callable[[int], None], gate: PermissionGate = OPEN_GATE
    ) -> None:
        self._gate = gate
        self._absent: OrderedDict[int, Absent] = OrderedDict()
        self._uncount = uncount
        self._forget = forget

    def get(self, peer: int) -> Absent | None:
        """The absent peer with this number."""
        return self._absent.get(peer)

    def add(self, absent: Absent) -> None:
        """Keep a peer whose proxies were removed."""
        self._absent[absent.peer] = absent
        while len(self._absent) > limits.ABSENT_PEERS_MAX:
            peer, _ = self._absent.popitem(last=False)
            self._uncount(peer)
            self._forget(peer)

    def number_of(self, identity: Identity) -> int | None:
        """The number of this very run of a peer, if ``back`` would return it; else ``None``."""
        for peer, absent in self._absent.items():
            if absent.identity.is_same_run(identity):
                return peer
            if absent.identity.is_same_module(identity, secured=self._gate.on):
                return None
        return None

    def back(self, identity: Identity) -> Absent | None:
        """Remove and return the absent peer of a new link: the same run, or an earlier run of its module."""
        for peer, absent in list(self._absent.items()):
            was = absent.identity
            if was.is_same_run(identity):
                return self._absent.pop(peer)
            if was.is_same_module(identity, secured=self._gate.on):
                for past in absent.pasts.values():
                    past.forget_position(missed=past.missed)
                return self._absent.pop(peer)
        return None

    def unheard(self, subscribed: Callable[[str], bool]) -> None:
        """Stop counting as missed what is published on topics without local subscribers.

        Args:
            subscribed: Whether a topic has local subscribers.
        """
        for absent in self._absent.values():
            for past in absent.pasts.values():
                if past.missed and not subscribed(past.topic):
                    past.forget_position(missed=False)

    def expire(self, now: float) -> None:
        """Stop counting for peers that have been away for longer than ``limits.OUTAGE_COUNTED``."""
        for peer, absent in list(self._absent.items()):
            if absent.counted and now - absent.since > limits.OUTAGE_COUNTED:
                self._absent[peer] = replace(absent, counted=False)
                self._uncount(peer)
