"""Reports subscribers whose type or definition does not fit a source, here and to the agent at the other end."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.bridge.actions import Send
from rmpa.bridge.messages import Mismatch
from rmpa.bridge.topics.mismatches import Mismatches

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rmpa.bridge.actions import Action
    from rmpa.bridge.messages import Source
    from rmpa.bridge.topics.exports import Exports
    from rmpa.bridge.topics.imports import Imports


class MismatchReports:
    """The mismatches of local subscribers with peers' sources, and of peers' subscribers with local sources.

    Args:
        exports: Finds the local source that a peer means.
        imports: Makes the message for the peer of a source; knows the peers that have a source.
        act: Carries out actions.
        on_warning: ``(counter, where, text)``: logs and counts a mismatch that a peer reports.
    """

    def __init__(
        self,
        exports: Exports,
        imports: Imports,
        act: Callable[[Sequence[Action]], None],
        on_warning: Callable[[str, str, str], None],
    ) -> None:
        self._exports = exports
        self._imports = imports
        self._act = act
        self._on_warning = on_warning
        self._mismatches = Mismatches()

    def texts(self, source: Source) -> tuple[str, ...]:
        """Texts about subscribers, here or at peers, whose definition does not fit a source's."""
        return self._mismatches.texts(source)

    def refused(self, peer: int, source: Source, subscriber: str, text: str) -> None:
        """A local subscriber does not fit a peer's source: remember it, and tell the peer."""
        self._mismatches.add(source, subscriber, text)
        self._act(self._imports.mismatched(peer, source, subscriber, text))

    def reported(self, peer: int, name: str, message: Mismatch) -> None:
        """A peer reports that a subscriber there does not fit a local source; an empty text: that it fits now."""
        source = self._exports.local(peer, message.source)
        if source is None:
            return  # it went meanwhile
        subscriber = f"{name}{message.subscriber}"
        if not message.text:
            self._mismatches.mended(source, subscriber)
            return
        self._mismatches.add(source, subscriber, message.text)
        where = f"{name}: {source}"
        self._on_warning("mismatch.remote", where, f"{where}: {message.text}")

    def registration_changed(self, topic: str, subscriber: str) -> None:
        """A local subscriber has gone or has registered again: forget its mismatch, here and at the peers."""
        if not self._mismatches:
            return
        for peer, source in list(self._imports.at(topic)):
            if self._mismatches.mended(source, subscriber):
                self._act([Send(peer, Mismatch(source.topic, source.node, subscriber, ""))])

    def peer_gone(self, name: str) -> None:
        """Forget all subscribers at a peer that is gone."""
        self._mismatches.peer_gone(name)

    def forget_gone(self) -> None:
        """Forget the mismatches of sources that are gone."""
        if self._mismatches:
            self._mismatches.keep(lambda source: source in self._exports.offered or self._imports.knows(source))
