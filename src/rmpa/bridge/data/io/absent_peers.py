"""Peers that are away for longer than their routes wait: what is known of them in case they come back."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from rmpa.mesh import limits

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.bridge.data.losses import ReceptionHistory
    from rmpa.bridge.messages import Source
    from rmpa.core.identity import Identity


@dataclass(frozen=True, slots=True)
class Absent:
    """A peer whose place in the local graph was given up.

    Args:
        peer: Its number, under which the outbound side counts what it misses.
        identity: Which run of which module it was.
        since: When its last link ended, monotonic seconds.
        pasts: What is known of the reliable sources that it brought.
        counted: Whether the outbound side still counts.
    """

    peer: int
    identity: Identity
    since: float
    pasts: dict[Source, ReceptionHistory]
    counted: bool = True


class AbsentPeers:
    """At most ``limits.ABSENT_PEERS_MAX`` of them; the one away for longest is forgotten first.

    Args:
        uncount: Called with a peer's number when what it misses is not to be counted any more.
        forget: Called with a peer's number when it is forgotten.
    """

    def __init__(self, uncount: Callable[[int], None], forget: Callable[[int], None]) -> None:
        self._absent: OrderedDict[int, Absent] = OrderedDict()
        self._uncount = uncount
        self._forget = forget

    def get(self, peer: int) -> Absent | None:
        """One of them, by its number."""
        return self._absent.get(peer)

    def add(self, absent: Absent) -> None:
        """A peer's place in the graph was given up."""
        self._absent[absent.peer] = absent
        while len(self._absent) > limits.ABSENT_PEERS_MAX:
            peer, _ = self._absent.popitem(last=False)
            self._uncount(peer)
            self._forget(peer)

    def number_of(self, identity: Identity) -> int | None:
        """The number of this very run of a peer, if ``back`` is going to return it."""
        for peer, absent in self._absent.items():
            if absent.identity.instance == identity.instance:
                return peer
            if absent.identity.guid.place == identity.guid.place or absent.identity.name == identity.name:
                return None
        return None

    def back(self, identity: Identity) -> Absent | None:
        """A peer has a link: itself, if it was away, or the run of its module that it follows; forgotten here."""
        for peer, absent in list(self._absent.items()):
            was = absent.identity
            if was.instance == identity.instance:
                return self._absent.pop(peer)
            if was.guid.place == identity.guid.place or was.name == identity.name:
                for past in absent.pasts.values():
                    past.forget_position(missed=past.missed)
                return self._absent.pop(peer)
        return None

    def unheard(self, subscribed: Callable[[str], bool]) -> None:
        """Nobody misses what comes on topics that nobody subscribes to any more."""
        for absent in self._absent.values():
            for past in absent.pasts.values():
                if past.missed and not subscribed(past.topic):
                    past.forget_position(missed=False)

    def expire(self, now: float) -> None:
        """Those away for longer than ``limits.OUTAGE_COUNTED`` are not counted for any more."""
        for peer, absent in list(self._absent.items()):
            if absent.counted and now - absent.since > limits.OUTAGE_COUNTED:
                self._absent[peer] = replace(absent, counted=False)
                self._uncount(peer)
