"""Peers of the same kind, *twins*, each of which drives the other by equal names.

Two identical robots offer the same topics (``/odom``, ``/scan``) and take the same commands (``/cmd_vel``). By
default one name is one topic in the whole mesh, so the command of one reaches both. In one robot that is split over
several modules a name is offered by one module, and taken by others.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Final

from rmpa.bridge.sessions import Part, PeerSession
from rmpa.core.identity import is_own, matches
from rmpa.core.log import RefusalLog
from rmpa.runtime.loop import SystemClock, yield_to_data

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from collections.abc import Set as AbstractSet

    from rmpa.bridge.bridge import Bridge
    from rmpa.bridge.subscriptions import Subscriptions
    from rmpa.ros.master.parameters import GraphState

_log = logging.getLogger(__name__)

# Names in common that make two modules twins.
_NAMES_MIN: Final = 3
# Of these, names that both offer: a driver and its driven have none, whatever passes between them.
OFFERED_MIN: Final = 2
_NAMES_SHOWN: Final = 4
# Names that modules of every kind may share: transforms, diagnostics, time, logs, and those of common tools.
_COMMON: Final = frozenset({
    "/tf", "/tf_static", "/diagnostics", "/diagnostics_agg", "/diagnostics_toplevel_state", "/statistics",
    "/client_count", "/connected_clients", "/clock", "/rosout", "/rosout_agg",
})  # fmt: skip
# Ends of names of nodes' own interfaces: dynamic_reconfigure, nodelets, Smart Resources.
_COMMON_ENDINGS: Final = (
    "/parameter_updates", "/parameter_descriptions", "/bond",
    "/quality", "/requirements", "/responses", "/observed", "/alarms", "/profile", "/context", "/state", "/decision",
    "/descriptor", "/set_context",
)  # fmt: skip


def telling(names: Iterable[str]) -> frozenset[str]:
    """The names that tell something of the kind of a module: not those that all modules may share."""
    return frozenset(name for name in names if name not in _COMMON and not name.endswith(_COMMON_ENDINGS))


def twin_names(
    offered: AbstractSet[str], taken: AbstractSet[str], offered_there: AbstractSet[str], taken_there: AbstractSet[str]
) -> tuple[str, ...]:
    """The names that make a peer a twin, those first by which one drives the other; empty: it is none.

    All by their names here, and only telling ones.

    Args:
        offered: What this module's own nodes publish.
        taken: What they subscribe to.
        offered_there: What the peer's own nodes publish here.
        taken_there: What they subscribe to.
    """
    both = offered & offered_there
    driven = taken & (taken_there | offered_there)
    if len(both) < OFFERED_MIN or not driven or len(both | driven) < _NAMES_MIN:
        return ()
    return (*sorted(driven), *sorted(both - driven))


def twin_text(peer: str, names: tuple[str, ...]) -> str:
    """What the user is told of a twin, with what to do behind the semicolon."""
    more = len(names) - _NAMES_SHOWN
    shown = ", ".join(names[:_NAMES_SHOWN]) + (f" and {more} more" if more > 0 else "")
    return (
        f"its nodes offer and take the same names as ours ({shown}), so each module drives the other; start both "
        f'with rmpa up --prefix-peers, or write in rmpa.toml below [[peer]]: name = "{peer}" and prefix = "/{{peer}}"'
    )


class TwinWatch(Part):
    """The part of the bridge that knows which peers are twins; it looks each ``limits.RECONCILE_INTERVAL``.

    Args:
        bridge: The local graph, the sessions and topics.
        subscriptions: What the nodes of peers subscribe to.
    """

    def __init__(self, bridge: Bridge, subscriptions: Subscriptions) -> None:
        self._bridge = bridge
        self._subscriptions = subscriptions
        self._clock = SystemClock()
        self._told = RefusalLog(_log, bridge.counters)
        self._state: GraphState | None = None
        self._offered: frozenset[str] = frozenset()
        self._taken: frozenset[str] = frozenset()
        self._twins: dict[int, tuple[str, ...]] = {}

    def problem(self, session: PeerSession) -> str:
        """What the user is told of a peer, while it is a twin; else empty."""
        names = self._twins.get(session.peer)
        return twin_text(session.link.name, names) if names else ""

    def reconcile(self) -> None:
        """Judge all peers again."""
        state = self._bridge.core.state()
        if state is not self._state:
            self._state = state
            self._offered, self._taken = telling(_own(state.publishers)), telling(_own(state.subscribers))
        for session in self._bridge.sessions.linked():
            yield_to_data()
            self._judge(session)

    def gone(self, session: PeerSession) -> None:
        """Forget a peer."""
        self._twins.pop(session.peer, None)

    def _judge(self, session: PeerSession) -> None:
        peer, name = session.peer, session.link.name
        if not self._offered or not self._taken or self._is_decided(name):
            self._set(session, ())
            return
        offers = self._bridge.topics.imports.offered_by(peer)
        offered_there = frozenset(
            topic
            for topic in (self._offered | self._taken).intersection(offers)
            if any(entry.shown and entry.origin is None for entry in offers[topic])
        )
        both = len(self._offered & offered_there) >= OFFERED_MIN
        taken_there = self._subscriptions.imports.topics(peer) if both else frozenset()
        self._set(session, twin_names(self._offered, self._taken, offered_there, taken_there))

    def _is_decided(self, name: str) -> bool:
        """Whether the user has decided about a peer: a ``[[peer]]`` table names it."""
        rules = self._bridge.context.settings.peers
        return any(rule.name != "*" and matches(rule.name, name) for rule in rules)

    def _set(self, session: PeerSession, names: tuple[str, ...]) -> None:
        before = self._twins.pop(session.peer, ())
        if names:
            self._twins[session.peer] = names
        name = session.link.name
        if names and not before:
            self._told.refuse(self._clock.now(), "peer.twin", name, f"{name}: {twin_text(name, names)}")
        elif before and not names:
            _log.info("= %s and this module share no commands any more", name)


def _own(table: Mapping[str, Mapping[str, str]]) -> list[str]:
    """The topics of a table of the graph that have a node of this module."""
    return [topic for topic, nodes in table.items() if not all(map(is_own, nodes))]
