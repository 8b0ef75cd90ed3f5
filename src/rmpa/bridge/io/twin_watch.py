"""Finds twins among the peers, and tells each that may be one what this module's nodes take."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any, Final

from rmpa.bridge import limits
from rmpa.bridge.permission_gate import Needs
from rmpa.bridge.policy import is_own
from rmpa.bridge.session.part import Part
from rmpa.bridge.twins import OFFERED_MIN, telling, twin_names, twin_text
from rmpa.config.peer_rules import Access
from rmpa.core.counters import RefusalLog
from rmpa.core.identity import is_global_name, matches
from rmpa.runtime.loop import SystemClock, yield_to_data

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.bridge.io.bridge import Bridge
    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.config.settings import PeerRule, Settings
    from rmpa.ros.core.api import Core
    from rmpa.ros.master.parameters import GraphState

_log = logging.getLogger(__name__)

TAKEN: Final = "names.taken"
"""The notification ``{"names": [...]}`` to a peer that offers what we do: the topics that nodes here subscribe to."""


class TwinWatch(Part):
    """The part of the bridge that knows which peers are twins; it looks each ``limits.RECONCILE_INTERVAL``.

    Args:
        core: The local graph.
        bridge: Its sessions, topics and requests.
        rules: The ``[[peer]]`` tables. A peer that one of them names is no twin: the user has decided about it.
    """

    def __init__(self, core: Core, bridge: Bridge, rules: tuple[PeerRule, ...]) -> None:
        self._core = core
        self._bridge = bridge
        self._rules = rules
        self._clock = SystemClock()
        self._told = RefusalLog(_log, bridge.counters)
        self._state: GraphState | None = None
        self._offered: frozenset[str] = frozenset()
        self._taken: frozenset[str] = frozenset()
        self._said: dict[int, tuple[str, ...]] = {}
        """By peer: the names that it was told last."""
        self._taken_there: dict[int, tuple[str, ...]] = {}
        """By peer: what its nodes take, by wire names, as it said last."""
        self._twins: dict[int, tuple[str, ...]] = {}
        bridge.rpc.on_notification(TAKEN, self._told_by_peer, Needs((), "names of the peer's own graph"))

    def problem(self, session: PeerSession) -> str:
        """What the user is told of a peer, while it is a twin; else empty."""
        names = self._twins.get(session.peer)
        return twin_text(session.link.name, names) if names else ""

    def reload(self, settings: Settings) -> None:
        """Take the rules of new settings."""
        self._rules = settings.peers

    def reconcile(self) -> None:
        """Judge all peers again."""
        state = self._core.state()
        if state is not self._state:
            self._state = state
            self._offered, self._taken = telling(_own(state.publishers)), telling(_own(state.subscribers))
        for session in self._bridge.sessions.linked():
            yield_to_data()
            self._judge(session)

    def link_up(self, session: PeerSession) -> None:
        """Forget what was said over an earlier link."""
        self._said.pop(session.peer, None)

    def gone(self, session: PeerSession) -> None:
        """Forget a peer."""
        for known in (self._said, self._taken_there, self._twins):
            known.pop(session.peer, None)

    def _judge(self, session: PeerSession) -> None:
        peer, name = session.peer, session.link.name
        if not self._offered or not self._taken or self._is_decided(name):
            self._set(session, ())
            return
        imports, rename = self._bridge.topics.imports, self._bridge.topics.names.of(name).local_name
        offers = imports.offered_by(peer)
        offered_there = frozenset(
            topic
            for topic in (self._offered | self._taken).intersection(offers)
            if any(
                (entry := imports.get(peer, source)) is not None and entry.shown and entry.origin is None
                for source in offers[topic]
            )
        )
        if len(self._offered & offered_there) >= OFFERED_MIN:
            self._say(session)
        taken_there = frozenset(map(rename, self._taken_there.get(peer, ())))
        self._set(session, twin_names(self._offered, self._taken, offered_there, taken_there))

    def _is_decided(self, name: str) -> bool:
        return any(rule.name != "*" and matches(rule.name, name) for rule in self._rules)

    def _set(self, session: PeerSession, names: tuple[str, ...]) -> None:
        before = self._twins.pop(session.peer, ())
        if names:
            self._twins[session.peer] = names
        name = session.link.name
        if names and not before:
            self._told.refuse(self._clock.now(), "peer.twin", name, f"{name}: {twin_text(name, names)}")
        elif before and not names:
            _log.info("= %s and this module share no commands any more", name)

    def _say(self, session: PeerSession) -> None:
        """Tell a peer what nodes here take of what it may publish here, if that has changed."""
        name = session.link.name
        wire, judge = self._bridge.topics.names.of(name).wire_name, self._bridge.gate.judge
        allowed = (each for each in sorted(self._taken) if judge(Access.PUBLISH, name, each).allowed)
        names = tuple(map(wire, allowed))[: limits.TWIN_NAMES_MAX]
        if session.linked and names != self._said.get(session.peer):
            self._said[session.peer] = names
            self._bridge.rpc.notify(session, TAKEN, {"names": names})

    def _told_by_peer(self, session: PeerSession, args: dict[str, Any]) -> None:
        names = args.get("names")
        found = names[: limits.TWIN_NAMES_MAX] if isinstance(names, list) else ()
        self._taken_there[session.peer] = tuple(
            name for name in found if isinstance(name, str) and is_global_name(name)
        )
        self._judge(session)


def _own(table: Mapping[str, Mapping[str, str]]) -> list[str]:
    """The topics of a table of the graph that have a node of this module."""
    return [topic for topic, nodes in table.items() if not all(map(is_own, nodes))]
