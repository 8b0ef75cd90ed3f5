"""Whom a beacon passes on, and who gets one by unicast: so many of many, in turn."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from rmpa.core.token_bucket import TokenBucket
from rmpa.discovery import limits

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rmpa.core.guid import Guid
    from rmpa.discovery.endpoint import PeerInstance


class GossipSelector:
    """Chooses the peers that one beacon passes on."""

    def __init__(self) -> None:
        self._turn = 0

    def choose(
        self, voices: Sequence[PeerInstance], to: PeerInstance | None, now: float, *, near: bool
    ) -> tuple[Guid, ...]:
        """GUIDs to pass on, in order; where they are too many for one beacon, in turn.

        Who has no link and was not heard of late is left out: others would greet it for as long as we speak of it.

        Args:
            voices: Who is known.
            to: Who is told, if it is one alone.
            now: Monotonic seconds.
            near: Whether those who are told can reach loopback addresses.
        """
        count = len(voices)
        start = self._turn % count if count > limits.BEACON_GOSSIP_MAX else 0
        guids: list[Guid] = []
        for number in range(start, start + count):
            voice = voices[number % count]
            if voice is to or not (voice.linked or now - voice.heard <= limits.MULTICAST_SILENCE):
                continue
            guid = voice.identity.guid
            if near or not guid.is_loopback:
                guids.append(guid)
                if len(guids) == limits.BEACON_GOSSIP_MAX:
                    self._turn = number + 1
                    break
        return tuple(guids)


class UnicastHeartbeats:
    """Chooses who gets a heartbeat by unicast: all that are linked; of the others, who may be invented, a few."""

    def __init__(self) -> None:
        self._turn = 0
        self._allowed = TokenBucket(
            limits.WHISPERS_PER_SECOND, limits.WHISPERS_PER_SECOND * limits.HEARTBEAT_INTERVAL
        )
        self._waiting: deque[PeerInstance] = deque()
        self.at: float | None = None
        """When ``some`` has somebody."""

    def choose(self, voices: Sequence[PeerInstance], now: float) -> tuple[list[PeerInstance], bool]:
        """Those of ``voices`` who get one now, the others in turn from call to call; whether that is all of them."""
        chosen = [voice for voice in voices if voice.linked]
        others = [voice for voice in voices if not voice.linked]
        start = self._turn % len(others) if others else 0
        for voice in others[start:] + others[:start]:
            if not self._allowed.take(now):
                return chosen, False
            chosen.append(voice)
            self._turn = (self._turn + 1) % len(others)
        return chosen, True

    def plan(self, voices: Sequence[PeerInstance], now: float) -> bool:
        """Let those whom ``choose`` chooses have one; whether that is all of them."""
        chosen, everybody = self.choose(voices, now)
        waiting = set(map(id, self._waiting))
        self._waiting += [voice for voice in chosen if id(voice) not in waiting]
        self.at = now if self._waiting else None
        return everybody

    def some(self) -> list[PeerInstance]:
        """The next of them; so few that whoever else has something to do need not wait."""
        few = [self._waiting.popleft() for _ in range(min(limits.WHISPERS_AT_ONCE, len(self._waiting)))]
        if not self._waiting:
            self.at = None
        return few
