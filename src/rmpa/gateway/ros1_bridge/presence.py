"""What bridges have, by the presence that they put each second, as a machine.

Bridges that announce the same thing take turns (the bridge's ``aloha_declaration.rs``): one that hears another of the
same key may stop. So what this gateway announces too is never missed while it does.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.gateway.ros1_bridge import limits

if TYPE_CHECKING:
    from collections.abc import Collection

    from rmpa.gateway.ros1_bridge.keys import BridgedKind, BridgedTopic

    Announced = tuple[BridgedKind, BridgedTopic]


class PresenceTable:
    """The topics and services that bridges announce."""

    def __init__(self) -> None:
        self._seen: dict[Announced, float] = {}
        self.ignored = 0
        """Announcements beyond ``limits.REMOTE_MAX``."""

    @property
    def present(self) -> Collection[Announced]:
        """What is there now."""
        return self._seen.keys()

    def seen(self, what: Announced, now: float) -> bool:
        """An announcement came; returns whether it is new.

        Args:
            what: Its kind and topic.
            now: Monotonic seconds.
        """
        new = what not in self._seen
        if new and len(self._seen) >= limits.REMOTE_MAX:
            self.ignored += 1
            return False
        self._seen[what] = now
        return new

    def expire(self, now: float, own: Collection[Announced]) -> list[Announced]:
        """Forget what was not announced for ``limits.PRESENCE_LEASE`` seconds, and return it.

        Args:
            now: Monotonic seconds.
            own: What this gateway announces itself.
        """
        for what in own:
            if what in self._seen:
                self._seen[what] = now
        gone = [what for what, at in self._seen.items() if now - at > limits.PRESENCE_LEASE]
        for what in gone:
            del self._seen[what]
        return gone
