"""Subscribers that do not fit a source, here and at the peers: what ``rmpa topic info`` and the diagnostics show."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.bridge import limits

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.bridge.messages import Source


class Mismatches:
    """Texts by source and subscriber.

    Subscriber: a local one's name (``/viewer``), or one at a peer behind the peer's name (``base/viewer``).
    """

    def __init__(self) -> None:
        self._texts: dict[Source, dict[str, str]] = {}

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self._texts)

    def texts(self, source: Source) -> tuple[str, ...]:
        """All about one source, ready to read."""
        return tuple(self._texts.get(source, {}).values())

    def add(self, source: Source, who: str, text: str) -> None:
        """Remember one, or say it anew; beyond ``limits.MISMATCHES_MAX`` of one source no more are remembered."""
        known = self._texts.setdefault(source, {})
        if who in known or len(known) < limits.MISMATCHES_MAX:
            known[who] = text

    def mended(self, source: Source, who: str) -> bool:
        """It fits now, or has gone; whether it did not fit before."""
        return self._texts.get(source, {}).pop(who, None) is not None

    def peer_gone(self, name: str) -> None:
        """A peer is gone, with all its nodes that were refused."""
        for known in self._texts.values():
            for who in [who for who in known if who == name or who.startswith(name + "/")]:
                del known[who]

    def keep(self, wanted: Callable[[Source], bool]) -> None:
        """Forget all sources but these."""
        for source in [source for source in self._texts if not wanted(source)]:
            del self._texts[source]
