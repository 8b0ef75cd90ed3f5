"""Modules that are heard in the network and are not of this mesh, for the user: one of the two has not joined."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from rmpa.core.counters import TokenBucket
from rmpa.discovery import limits
from rmpa.discovery.beacon import BeaconKind

if TYPE_CHECKING:
    from rmpa.core.identity import Identity
    from rmpa.discovery.beacon import Beacon


@dataclass(slots=True)
class Stranger:
    """One module whose beacons are refused. Nothing that it says is proved.

    Args:
        identity: As its last beacon said.
        problem: Why they are refused, and what to do.
        since: When it was first heard, monotonic seconds.
        heard: When it was last heard.
    """

    identity: Identity
    problem: str
    since: float
    heard: float


class Strangers:
    """The modules whose beacons are refused, few at a time: a full table takes no more until one falls silent."""

    def __init__(self) -> None:
        self._known: dict[tuple[str, int], Stranger] = {}
        self._rate = TokenBucket(limits.STRANGER_BEACONS_PER_SECOND, limits.STRANGER_BEACONS_PER_SECOND)

    def may_read(self, now: float) -> bool:
        """Whether one more refused beacon may be parsed for its name."""
        return self._rate.take(now)

    def hear(self, beacon: Beacon, problem: str, now: float) -> bool:
        """Take in a refused beacon; return whether its sender is shown."""
        self._expire(now)
        identity = beacon.identity
        key = identity.name, identity.guid.place
        if beacon.kind is BeaconKind.GOODBYE:
            self._known.pop(key, None)
            return False
        known = self._known.get(key)
        if known is not None:
            known.identity, known.problem, known.heard = identity, problem, now
        elif len(self._known) < limits.STRANGERS_SHOWN:
            self._known[key] = Stranger(identity, problem, now, now)
        return key in self._known

    def shown(self, now: float) -> tuple[Stranger, ...]:
        """Those that were heard lately, in the order in which they were found."""
        self._expire(now)
        return tuple(self._known.values())

    def _expire(self, now: float) -> None:
        for key in [key for key, one in self._known.items() if now - one.heard > limits.STRANGER_KEPT]:
            del self._known[key]
