"""The log of all modules: each keeps its own last lines, and tells them to those that ask; nothing is streamed."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import time
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.bridge import limits
from rmpa.bridge.log_ring import LogQuery, LogRing, ModuleLog
from rmpa.bridge.nodes import own_node, permitted_nodes
from rmpa.bridge.policy import Needs
from rmpa.bridge.rpc import gate_for, meant, no_such_module
from rmpa.bridge.sessions import Part, PeerSession
from rmpa.config.peer_rules import Access
from rmpa.core.errors import RmpaError
from rmpa.core.identity import OWN_NODE, is_own
from rmpa.ros.core.embedded import AGGREGATED, LOG, TOPIC
from rmpa.ros.master.parameters import GraphChange, RegistrationKind
from rmpa.ros.node.loggers import read_levels, set_level
from rmpa.ros.node.slave_node import Subscription
from rmpa.runtime.loop import yielding_to_data
from rmpa.trust.permissions import asker_name

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.bridge.bridge import Bridge
    from rmpa.ros.node.subscription import PublisherConnection

_log = logging.getLogger(__name__)

# The request for log lines of the module's nodes and its agent, as ``LogQuery``; the response is ``ModuleLog``.
LINES: Final = "log.lines"
# The request for the levels of a ``node``'s loggers by name; with a ``level``: that of its ``logger`` is set, and the
# response has what was set.
LEVEL: Final = "log.level"


class _Records(logging.Handler):
    """Puts the agent's own log into the ring; records may come from any thread."""

    def __init__(self, ring: LogRing) -> None:
        super().__init__()
        self._ring = ring
        self._loop = asyncio.get_running_loop()
        self._thread = threading.get_ident()

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a record."""
        try:
            line = record.levelno, round(record.created * 1e9), self.format(record)
        except Exception:  # noqa: BLE001 - a line that cannot be formatted must not end what logs it
            self.handleError(record)
            return
        if threading.get_ident() == self._thread:
            self._ring.take_own(*line)
        else:
            with contextlib.suppress(RuntimeError):  # the loop is closed: the agent ends
                self._loop.call_soon_threadsafe(self._ring.take_own, *line)


class ModuleLogs(Part):
    """The part of the bridge that keeps this module's log, and reads those of the peers.

    The embedded core passes each message of /rosout on. Of a roscore the agent's own node subscribes to /rosout_agg;
    where /rosout itself crosses, to that, since the other one has no word of the publisher: a proxy's line is kept by
    its own module alone.

    Args:
        bridge: The core, the peers and the rules.
    """

    def __init__(self, bridge: Bridge) -> None:
        self._bridge = bridge
        self._core = bridge.core
        self.ring = LogRing(time.time_ns())
        self._handler: _Records | None = None
        self._subscription: Subscription | None = None
        bridge.rpc.on_request(LINES, self._lines, Needs((Access.LOG,), "each line's node; others are left out"))
        bridge.rpc.on_request(LEVEL, self.level, Needs((Access.LOG,), "the node"))

    def start(self) -> None:
        """Begin to keep lines."""
        self._handler = _Records(self.ring)
        logging.getLogger().addHandler(self._handler)
        if not self._core.on_log(self._take):
            self._follow()

    async def close(self) -> None:
        """Keep none any more."""
        if self._handler is not None:
            logging.getLogger().removeHandler(self._handler)

    def reload(self) -> None:
        """Subscribe to the other topic, if /rosout crosses now, or no more."""
        if self._subscription is not None:
            self._follow()

    def graph_changed(self, change: GraphChange) -> None:
        """Connect to another publisher: a restarted roscore does not tell of those that were there before."""
        followed = self._subscription
        if followed is not None and change.kind is RegistrationKind.PUBLISHER and change.name == followed.topic:
            followed.update(list(self._core.publishers(followed.topic).values()))

    def reconcile(self) -> None:
        """Register again: the roscore has been restarted."""
        if self._subscription is not None and OWN_NODE not in self._core.subscribers(self._subscription.topic):
            self._register(self._subscription)

    def _take(self, publisher: str, framed: memoryview) -> None:
        if not is_own(publisher):
            self.ring.take(publisher, framed, time.time_ns())

    def _follow(self) -> None:
        node = self._bridge.node
        topic = TOPIC if self._bridge.context.settings.rosout else AGGREGATED
        if self._subscription is not None:
            if self._subscription.topic == topic:
                return
            self._core.call("unregisterSubscriber", OWN_NODE, self._subscription.topic, node.uri)
            node.remove_subscription(self._subscription)

        def received(publisher: PublisherConnection, framed: memoryview) -> None:
            nodes = self._core.publishers(topic).items()
            self._take(next((name for name, uri in nodes if uri == publisher.uri), AGGREGATED), framed)

        self._subscription = Subscription(topic, node, on_message=received, wanted=LOG)
        node.add_subscription(self._subscription)
        self._register(self._subscription)

    def _register(self, subscription: Subscription) -> None:
        self._core.call("registerSubscriber", OWN_NODE, subscription.topic, LOG.type, self._bridge.node.uri)
        subscription.update(list(self._core.publishers(subscription.topic).values()))

    def _lines(self, asker: PeerSession | None, args: Mapping[str, Any]) -> ModuleLog:
        query, (gate, peer) = LogQuery.of(args), gate_for(self._bridge, asker)
        allowed = {node for node in self.ring.nodes if not gate.on or gate.judge(Access.LOG, peer, node).allowed}
        if not allowed and (why := gate.why_not(Access.LOG, peer, query.node or OWN_NODE)):
            raise RmpaError(why, code="not-permitted")
        return self.ring.find(query, time.time_ns(), allowed.__contains__, yielding_to_data)

    async def read(self, args: Mapping[str, Any]) -> list[ModuleLog]:
        """Log lines of this module and of its peers, which are asked at one time.

        Args:
            args: The fields of ``LogQuery``, but ``after`` by name of a module; and ``modules``, names or GUIDs,
                without which all are asked.

        Raises:
            ConfigError: One of them is none.
        """
        args = dict(args)
        wanted, after = args.pop("modules", None), args.pop("after", None)
        query = msgspec.to_builtins(LogQuery.of(args))
        own, sessions = self._bridge.context.settings.name, [*self._bridge.sessions]

        async def of(name: str, session: PeerSession | None) -> ModuleLog:
            number = after.get(name) if isinstance(after, dict) else None
            its = query | ({"after": number} if isinstance(number, int) and number >= 0 else {})
            if session is not None:
                return await self._ask(session, its)
            if name == own:
                return msgspec.structs.replace(self._lines(None, its), module=own, error=0.0)
            error = no_such_module(name, own, sessions)
            return ModuleLog(module=name, problem=str(error), code=error.code)

        names = map(str, wanted) if isinstance(wanted, list) else (own, *(str(one.link.guid) for one in sessions))
        asked: list[tuple[str, PeerSession | None]] = []
        for name in names:
            found = [(one.link.name, one) for one in meant(sessions, name)]
            asked += [(own, None)] if name == own else found or [(name, None)]
        return await asyncio.gather(*(of(*each) for each in asked))

    async def _ask(self, session: PeerSession, query: dict[str, Any]) -> ModuleLog:
        """The lines of a peer."""
        if not session.linked:
            text = "it is silent: there is no link to it now"
            return ModuleLog(module=session.link.name, problem=text, code="peer-unlinked")
        found = await self._bridge.rpc.ask(session, LINES, query, ModuleLog, limits.LOG_ASK_TIMEOUT)
        ahead, bound = session.time.ahead_ns / 1e9, session.time.error_ns
        lines = (msgspec.structs.replace(line, at=line.at - ahead) for line in yielding_to_data(found.lines))
        error = None if bound is None or found.problem else bound / 1e9
        return msgspec.structs.replace(found, lines=(*lines,), error=error)

    async def level(self, asker: PeerSession | None, args: Mapping[str, Any]) -> dict[str, str]:
        """The levels of the loggers of a ``node`` of this module, by name; with ``level``: those that were set to it.

        Raises:
            RmpaError: There is no such node, level or logger, or it does not answer, or the asker may not.
        """
        nodes = permitted_nodes(self._bridge, Access.LOG, asker, args)
        node, api = own_node(self._bridge, args, nodes, agents=True)
        uri = self._core.registrations.service_uri(f"{node}/get_loggers")
        if uri is None:
            raise RmpaError(f"{node} has no loggers", code="unknown-name")
        logger, level = str(args.get("logger", "")), str(args.get("level", "")).lower()
        if not level:
            return await read_levels(uri, api, node, OWN_NODE)
        levels = await set_level(uri, node, OWN_NODE, logger, level)
        who = asker_name(asker.link.name) if asker is not None else "this module"
        _log.info("= %s has set the level of %s of %s to %s", who, " and ".join(levels), node, level)
        return levels
