"""Announces what this site has to bridges: an empty put each second for each."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Final

from rmpa.gateway.zenoh_api import ZenohPriority, ZenohQos

if TYPE_CHECKING:
    from collections.abc import Collection

    from rmpa.gateway.ros1_bridge.keys import BridgedKind, BridgedTopic
    from rmpa.gateway.zenoh_api import ZenohPublisher, ZenohSession

OWN_DISCOVERY: Final = "rmpa"
"""The namespace of discovery of gateways. Bridges listen to all by default; gateways leave each other's out, as they
are joined as sites."""
_QOS: Final = ZenohQos(reliable=False, block=False, priority=ZenohPriority.BACKGROUND, messages=1)


class BridgeAnnouncer:
    """Puts presence; what several announce is put once.

    Args:
        session: The Zenoh session.
    """

    def __init__(self, session: ZenohSession) -> None:
        self._session = session
        self._publishers: dict[tuple[BridgedKind, BridgedTopic], ZenohPublisher] = {}
        self._uses: Counter[tuple[BridgedKind, BridgedTopic]] = Counter()

    @property
    def announced(self) -> Collection[tuple[BridgedKind, BridgedTopic]]:
        """What is announced now."""
        return self._publishers.keys()

    def add(self, kind: BridgedKind, topic: BridgedTopic) -> None:
        """Announce something from now on."""
        what = kind, topic
        self._uses[what] += 1
        if self._uses[what] == 1:
            key = topic.presence(kind, OWN_DISCOVERY)
            publisher = self._publishers[what] = self._session.publisher(key, _QOS, lambda _: None)
            publisher.put(b"")

    def remove(self, kind: BridgedKind, topic: BridgedTopic) -> None:
        """Announce it no more, if it was the last use."""
        what = kind, topic
        self._uses[what] -= 1
        if self._uses[what] <= 0:
            del self._uses[what]
            self._publishers.pop(what).close()

    def beat(self) -> None:
        """Put presence once; called each second."""
        for publisher in self._publishers.values():
            publisher.put(b"")

    def close(self) -> None:
        """Announce nothing more."""
        for publisher in self._publishers.values():
            publisher.close()
        self._publishers.clear()
        self._uses.clear()
