"""Subscribers whose type or definition does not fit a source, for ``rmpa topic info`` and the diagnostics."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.bridge import limits

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.bridge.messages import Source


class Mismatches:
    """Texts by source and subscriber.

    A subscriber is given by its name: ``/viewer`` here, ``base/viewer`` at the peer ``base``.
    """

    def __init__(self) -> None:
        self._texts: dict[Source, dict[str, str]] = {}

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self._texts)

    def texts(self, source: Source) -> tuple[str, ...]:
        """The texts about one source."""
        return tuple(self._texts.get(source, {}).values())

    def add(self, source: Source, subscriber: str, text: str) -> None:
        """Remember a mismatch, or replace its text; dropped beyond ``limits.MISMATCHES_MAX`` for one source."""
        known = self._texts.setdefault(source, {})
        if subscriber in known or len(known) < limits.MISMATCHES_MAX:
            known[subscriber] = text

    def mended(self, source: Source, subscriber: str) -> bool:
        """Forget a subscriber that fits now or has gone; return whether it was remembered."""
        return self._texts.get(source, {}).pop(subscriber, None) is not None

    def peer_gone(self, name: str) -> None:
        """Forget all subscribers at a peer that is gone."""
        for known in self._texts.values():
            for subscriber in [one for one in known if one == name or one.startswith(name + "/")]:
                del known[subscriber]

    def keep(self, wanted: Callable[[Source], bool]) -> None:
        """Forget the sources for which ``wanted`` is false."""
        for source in [source for source in self._texts if not wanted(source)]:
            del self._texts[source]
