"""The Zenoh session of a gateway: the one place that calls the library ``eclipse-zenoh``.

The event loop never waits for Zenoh. Declarations and their ends go in order to one thread, queries and their answers
to a second one, and messages to a thread for each priority. What Zenoh delivers comes by queues; both are in
``threads``.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import threading
from typing import TYPE_CHECKING, Any, Final

from rmpa.core.errors import StartError, missing_extra
from rmpa.gateway import limits
from rmpa.gateway.zenoh.config import ZenohConfig, bound_unsent, reason_of, session_config
from rmpa.gateway.zenoh.threads import (
    ArrivalQueue,
    Arrivals,
    QueuedPublisher,
    SendingLane,
    SerialWorker,
    ZenohPriority,
    ZenohSample,
    call_loop,
    keep_thread_state,
)
from rmpa.runtime.accept import in_thread
from rmpa.runtime.loop import Delay

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.bridge.policy import Needs
    from rmpa.config.settings import Settings
    from rmpa.gateway.zenoh.threads import ZenohQos
    from rmpa.ros.wire.tcpros import Buffer

_log = logging.getLogger(__name__)

# Seconds between two looks at which connections Zenoh has, to bound what the kernel holds of new ones.
_LOOK_AT_LINKS: Final = 2.0
# Seconds that closing a session may take before it is given up; its threads do not keep the process from ending.
_CLOSE_MAX: Final = 3.0
# Seconds beyond a query's own time-out after which its answers are no longer waited for.
_GET_GRACE: Final = 1.0

_BUSY: Final = "too many answers wait at this gateway; ask again later"


def content(data: Any) -> bytes:
    """The bytes of a payload or an attachment of Zenoh; empty for none."""
    return b"" if data is None else bytes(data.to_bytes())


class ArrivedQuery:
    """A query that has come, and whose answers go out by a thread.

    Args:
        query: Zenoh's query.
        worker: The thread that answers.
        arrivals: Has room for the answers that wait.
    """

    def __init__(self, query: Any, worker: SerialWorker, arrivals: Arrivals) -> None:
        self._query: Any = query
        self._worker = worker
        self._arrivals = arrivals
        self.key = str(query.key_expr)
        self.parameters = str(query.parameters)
        self.payload = content(query.payload)
        self.attachment = content(query.attachment)

    def reply(self, payload: Buffer, attachment: bytes = b"") -> None:
        """Give the answer, and finish."""
        query = self._query
        if query is None:
            return
        if not self._arrivals.take_room(len(payload)):
            self.reply_error(_BUSY)
            return
        body = payload if isinstance(payload, bytes) else bytes(payload)
        self._worker.submit(lambda: self._give(query, body, attachment))
        self.finish()

    def _give(self, query: Any, body: bytes, attachment: bytes) -> None:
        try:
            query.reply(self.key, body, attachment=attachment or None)
        finally:
            self._arrivals.free_room(len(body))

    def reply_error(self, text: str) -> None:
        """Answer with an error, and finish."""
        query = self._query
        if query is not None:
            self._worker.submit(lambda: query.reply_err(text))
            self.finish()

    def finish(self) -> None:
        """Say that no answer comes."""
        query, self._query = self._query, None
        if query is not None:
            self._worker.submit(query.drop)


class PendingGet:
    """A query that was asked; collects its answers in Zenoh's threads, within ``limits.REPLIES_MAX``.

    Args:
        done: Resolved in the event loop with all answers, as soon as there are too many.
        arrivals: Counts answers that are dropped, and calls functions in the event loop.

    Attributes:
        unfinished: Whether it was resolved because there were too many answers, and more may come.
    """

    def __init__(self, done: asyncio.Future[list[ZenohSample]], arrivals: Arrivals) -> None:
        self._done = done
        self._arrivals = arrivals
        self._lock = threading.Lock()
        self._replies: list[ZenohSample] = []
        self._bytes = 0
        self.unfinished = False

    def add(self, reply: Any) -> None:
        """Take one answer. Zenoh's own for a time-out, here or in a router on the way, is left out."""
        if self.unfinished:
            self._arrivals.refuse("zenoh.reply.limit")
            return
        sample = reply.ok
        if sample is not None:
            if sample.attachment is not None and len(sample.attachment) > limits.ATTACHMENT_MAX:
                self._arrivals.refuse("zenoh.attachment.long")
                return
            answer = ZenohSample(content(sample.payload), content(sample.attachment))
        elif reply.replier_id is None or not reply.replier_id.eid:
            return  # no queryable has the entity id 0
        else:
            answer = ZenohSample(content(reply.err.payload), ok=False)
        size = len(answer.payload) + len(answer.attachment)
        with self._lock:
            self.unfinished = bool(self._replies) and (
                len(self._replies) >= limits.REPLIES_MAX or self._bytes + size > limits.REPLY_BYTES_MAX
            )
            if not self.unfinished:
                self._bytes += size
                self._replies.append(answer)
                return
        self._arrivals.refuse("zenoh.reply.limit")
        self.finish()

    def finish(self) -> None:
        """Resolve with what has come; called from any thread, and again without effect."""
        call_loop(self._arrivals.loop, self._settle)

    def collected(self) -> list[ZenohSample]:
        """The answers up to now."""
        with self._lock:
            return list(self._replies)

    def _settle(self) -> None:
        if not self._done.done():
            self._done.set_result(self.collected())


class Declaration:
    """Something that is declared in order by a thread, and undeclared once it is closed.

    Args:
        worker: The thread that declares.
        kept: The open declarations of the session: Zenoh undeclares what is not referred to.
        declare: Makes Zenoh's object, or several that are undeclared together.
        queue: Its arrivals; ``None`` if it has none.
    """

    def __init__(
        self,
        worker: SerialWorker,
        kept: set[Declaration],
        declare: Callable[[], list[Any]],
        queue: ArrivalQueue[Any] | None = None,
    ) -> None:
        self._worker = worker
        self._kept = kept
        self._queue = queue
        self._declare = declare
        self._objects: list[Any] = []
        self._closed = False
        kept.add(self)
        worker.submit(self._begin)

    def close(self) -> None:
        """Undeclare it; no callback is called afterwards."""
        if not self._closed:
            self._closed = True
            self._kept.discard(self)
            if self._queue is not None:
                self._queue.close()
            self._worker.submit(self._end)

    def _begin(self) -> None:
        if not self._closed:
            self._objects = self._declare()

    def _end(self) -> None:
        objects, self._objects = self._objects, []
        for thing in objects:
            thing.undeclare()


class OpenSession:
    """An open session; ``open_session`` makes it.

    Args:
        library: The module ``zenoh``.
        session: Zenoh's session.
        config: What it was opened with.
        settings: What that was made of, and is made of again; ``None``: it stays as it is.
    """

    def __init__(self, library: Any, session: Any, config: ZenohConfig, settings: Settings | None) -> None:
        self._zenoh = library
        self._session = session
        self._config = config
        self._stamp = config.stamp()
        self._settings = settings
        # The event loop in which all callbacks are called.
        self._loop = loop = asyncio.get_running_loop()
        self.zid = str(session.zid())
        self._arrivals = Arrivals(loop)
        self._declarations = SerialWorker("zenoh declarations")
        self._queries = SerialWorker("zenoh queries")
        self._lanes: dict[ZenohPriority, SendingLane] = {}
        self._publishers: set[QueuedPublisher] = set()
        self._kept: set[Declaration] = set()
        self._closing = False
        self._closed = False
        self._flushed = asyncio.Event()
        # The endpoints whose sockets are bounded.
        self._bounded: frozenset[str] = frozenset()
        self._looking = Delay()
        self._look_at_links()

    @property
    def endpoints(self) -> tuple[str, ...]:
        """The endpoints of the other side of each link that is up now, such as ``tcp/192.0.2.1:7447``."""
        return () if self._closed else tuple(str(link.dst) for link in self._session.info.links())

    def _look_at_links(self) -> None:
        there = frozenset(self.endpoints)
        if new := there - self._bounded:
            bound_unsent(new)
        self._bounded = there
        self._looking.set(_LOOK_AT_LINKS, self._look_at_links)

    @property
    def stale(self) -> bool:
        """Whether it has to be opened anew for others to connect: its certificate or table of access is another.

        Zenoh reads the table and the certificate of a listener once, and that of a connection each time. The table is
        another where a module was revoked, or has joined since.
        """
        renewed = self._config.stamp() != self._stamp
        if renewed or self._settings is None:
            return renewed
        try:
            return session_config(self._settings).access_control != self._config.access_control
        except StartError:
            return False  # files are being written

    def publisher(self, key: str, qos: ZenohQos, on_matching: Callable[[bool], None]) -> QueuedPublisher:
        """Declare a publisher; ``on_matching(there)`` tells whether there is a subscriber, also at the beginning."""
        last: list[bool] = []

        def matched(there: bool) -> None:
            if last != [there]:
                last[:] = [there]
                on_matching(there)

        queue = ArrivalQueue(self._arrivals, matched, 1, 0)

        def undeclare() -> None:
            self._publishers.discard(publisher)
            if not self._publishers and self._closing:
                self._flushed.set()
            declaration.close()

        def declare() -> list[Any]:
            terms = self._terms(qos)
            plain = self._session.declare_publisher(key, **terms)
            listener = plain.declare_matching_listener(self._direct(lambda status: queue.add(bool(status.matching))))
            queue.add(bool(plain.matching_status.matching))
            objects = [listener, plain]
            if qos.cache:
                objects.append(self._cached(key, qos, terms))
            publisher.declared(objects[-1])
            return objects

        publisher = QueuedPublisher(self._lane(qos.priority), key, qos, undeclare)
        declaration = self._declare(key, declare, queue)
        self._publishers.add(publisher)
        return publisher

    def subscribe(
        self,
        key: str,
        on_sample: Callable[[ZenohSample], object],
        *,
        history: bool = False,
    ) -> Declaration:
        """Subscribe to a key; ``history``: ask publishers with a cache for what they keep."""
        queue = ArrivalQueue(self._arrivals, on_sample, limits.ARRIVED_MESSAGES, limits.ARRIVED_BYTES)
        put = self._zenoh.SampleKind.PUT

        def arrived(sample: Any) -> None:
            if sample.kind == put and self._readable(sample.attachment):
                payload, attachment = content(sample.payload), content(sample.attachment)
                queue.add(ZenohSample(payload, attachment), len(payload) + len(attachment))

        def declare() -> list[Any]:
            if not history:
                return [self._session.declare_subscriber(key, self._direct(arrived))]
            from zenoh import ext  # noqa: PLC0415 - the library is imported by what opens a session alone

            asked = ext.HistoryConfig(detect_late_publishers=True)
            return [ext.declare_advanced_subscriber(self._session, key, self._direct(arrived), history=asked)]

        return self._declare(key, declare, queue)

    def token(self, key: str) -> Declaration:
        """Declare a liveliness token."""
        return self._declare(key, lambda: [self._session.liveliness().declare_token(key)])

    def watch_tokens(self, key: str, on_token: Callable[[str, bool], None]) -> Declaration:
        """Call ``on_token(key, alive)`` for each token that is there, and at each change."""
        put = self._zenoh.SampleKind.PUT
        queue: ArrivalQueue[tuple[str, bool]] = ArrivalQueue(
            self._arrivals, lambda change: on_token(*change), limits.ARRIVED_TOKENS, limits.ARRIVED_TOKEN_BYTES
        )

        def arrived(sample: Any) -> None:
            name = str(sample.key_expr)
            if self._short(name):
                queue.add((name, sample.kind == put), len(name))

        def declare() -> list[Any]:
            return [self._session.liveliness().declare_subscriber(key, self._direct(arrived), history=True)]

        return self._declare(key, declare, queue)

    def queryable(
        self,
        key: str,
        on_query: Callable[[ArrivedQuery], object],
        _needs: Needs | None = None,
    ) -> Declaration:
        """Answer queries."""
        queue: ArrivalQueue[ArrivedQuery] = ArrivalQueue(
            self._arrivals,
            on_query,
            limits.ARRIVED_QUERIES,
            limits.ARRIVED_BYTES,
            discard=lambda query: query.finish(),
        )

        def arrived(query: Any) -> None:
            if not (
                self._readable(query.attachment)
                and self._short(str(query.key_expr))
                and self._short(str(query.parameters))
            ):
                query.drop()
                return
            arrival = ArrivedQuery(query, self._queries, self._arrivals)
            queue.add(arrival, len(arrival.payload))

        def declare() -> list[Any]:
            return [self._session.declare_queryable(key, self._direct(arrived), complete=True)]

        return self._declare(key, declare, queue)

    async def get(
        self,
        selector: str,
        payload: Buffer = b"",
        attachment: bytes = b"",
        *,
        timeout: float = 5.0,  # noqa: ASYNC109 - Zenoh ends the query by itself
        all_complete: bool = False,
        priority: ZenohPriority = ZenohPriority.DATA,
    ) -> list[ZenohSample]:
        """Ask; wait for all answers, or for ``timeout`` seconds. ``all_complete``: ask every complete queryable."""
        zenoh = self._zenoh
        self._check(selector.partition("?")[0])
        done: asyncio.Future[list[ZenohSample]] = self._loop.create_future()
        pending = PendingGet(done, self._arrivals)
        cancellation = zenoh.CancellationToken()
        body = payload if isinstance(payload, bytes) else bytes(payload)

        def ask() -> None:
            try:
                self._session.get(
                    selector,
                    self._direct(pending.add, pending.finish),
                    target=zenoh.QueryTarget.ALL_COMPLETE if all_complete else zenoh.QueryTarget.BEST_MATCHING,
                    consolidation=zenoh.ConsolidationMode.NONE,
                    congestion_control=zenoh.CongestionControl.BLOCK,
                    timeout=timeout,
                    priority=getattr(zenoh.Priority, priority.name),
                    payload=body,
                    attachment=attachment or None,
                    cancellation_token=cancellation,
                )
            except zenoh.ZError as error:
                _log.warning("! zenoh: the query %s was not sent: %s [zenoh-trouble]", selector, error)
                pending.finish()

        self._queries.submit(ask)
        try:
            async with asyncio.timeout(timeout + _GET_GRACE):
                return await done
        except TimeoutError:
            return pending.collected()
        finally:
            if pending.unfinished or not done.done() or done.cancelled():
                self._queries.submit(cancellation.cancel)

    async def close(self) -> None:
        """Close the session and end its threads; publishers send what waits, for a second at most."""
        if self._closing:
            return
        self._closing = True
        self._looking.cancel()
        if not self._publishers:
            self._flushed.set()
        for publisher in tuple(self._publishers):
            publisher.close()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(limits.FLUSH_MAX * 1.5):
                await self._flushed.wait()
        self._closed = True
        self._arrivals.close()
        await in_thread(self._end, "zenoh close")

    def _end(self) -> None:
        lanes = [lane.thread for lane in self._lanes.values()]
        for lane in self._lanes.values():
            lane.stop(discard=True)
        self._declarations.stop(discard=True)
        self._queries.stop(discard=True)
        closing = SerialWorker("zenoh session close")
        closing.submit(self._session.close)
        closing.stop()
        for each in (closing.thread, self._declarations.thread, self._queries.thread, *lanes):
            each.join(_CLOSE_MAX)
            if each.is_alive():
                _log.warning("! zenoh: a thread of the session did not end within %g s [ending-slowly]", _CLOSE_MAX)

    def _direct(self, callback: Callable[[Any], None], ended: Callable[[], None] | None = None) -> Any:
        """A callback that Zenoh calls in its own thread.

        By default it starts a thread for each one, with an unbounded queue in front of it.
        """

        def called(arrived: Any) -> None:
            keep_thread_state()
            callback(arrived)

        return self._zenoh.handlers.Callback(called, ended, indirect=False)

    def take_refused(self) -> dict[str, int]:
        """What was dropped or refused since the last call, by its reason, such as ``zenoh.reply.limit``."""
        with self._arrivals.lock:
            refused = dict(self._arrivals.refused)
            self._arrivals.refused.clear()
        return refused

    def _readable(self, attachment: Any) -> bool:
        """Whether an attachment may be copied; called in Zenoh's threads, before anything is."""
        if attachment is None or len(attachment) <= limits.ATTACHMENT_MAX:
            return True
        self._arrivals.refuse("zenoh.attachment.long")
        return False

    def _short(self, text: str) -> bool:
        """Whether a key, or a query's parameters, may be kept."""
        if len(text) <= limits.ZENOH_KEY_MAX:
            return True
        self._arrivals.refuse("zenoh.key.long")
        return False

    def _declare(
        self, key: str, declare: Callable[[], list[Any]], queue: ArrivalQueue[Any] | None = None
    ) -> Declaration:
        self._check(key)
        return Declaration(self._declarations, self._kept, declare, queue)

    def _check(self, key: str) -> None:
        """Refuse a key that Zenoh would refuse later, in another thread."""
        try:
            self._zenoh.KeyExpr(key)
        except self._zenoh.ZError as error:
            raise ValueError(f"{key!r} is not a key expression of Zenoh: {reason_of(error)}") from None

    def _lane(self, priority: ZenohPriority) -> SendingLane:
        lane = self._lanes.get(priority)
        if lane is None:
            name = f"zenoh {priority.name.lower().replace('_', ' ')}"
            lane = self._lanes[priority] = SendingLane(self._loop, name, (self._zenoh.ZError,))
        return lane

    def _terms(self, qos: ZenohQos) -> dict[str, Any]:
        zenoh = self._zenoh
        # Zenoh drops what is best effort after some milliseconds even where it is told to block, and counts nothing:
        # on a line of 1 Mbit/s no message of more than one batch came. Our queue drops, and counts.
        reliable = qos.reliable or qos.block
        return {
            "reliability": zenoh.Reliability.RELIABLE if reliable else zenoh.Reliability.BEST_EFFORT,
            "congestion_control": zenoh.CongestionControl.BLOCK if qos.block else zenoh.CongestionControl.DROP,
            "priority": getattr(zenoh.Priority, qos.priority.name),
            # A gateway must not hear itself; and the cache of an advanced publisher is no subscriber to wake up for.
            "allowed_destination": zenoh.Locality.REMOTE,
        }

    def _cached(self, key: str, qos: ZenohQos, terms: dict[str, Any]) -> Any:
        from zenoh import ext  # noqa: PLC0415 - as above

        return ext.declare_advanced_publisher(
            self._session,
            key,
            **terms,
            cache=ext.CacheConfig(
                qos.cache,
                replies_config=ext.RepliesConfig(
                    congestion_control=terms["congestion_control"], priority=terms["priority"]
                ),
            ),
            publisher_detection=True,
        )


async def open_session(config: ZenohConfig, settings: Settings | None = None) -> OpenSession:
    """Open a session, in a thread.

    Args:
        config: Its mode, endpoints and certificates.
        settings: What that was made of (``OpenSession.stale``).

    Raises:
        StartError: The library is missing, an address is taken, or the endpoints do not answer.
    """
    try:
        import zenoh  # noqa: PLC0415 - it is an extra
    except ImportError:
        raise StartError(
            "zenoh", "eclipse-zenoh is not installed", missing_extra("zenoh"), code="extra-missing"
        ) from None
    terms = zenoh.Config()
    try:
        for key, value in config.entries().items():
            terms.insert_json5(key, json.dumps(value))
        session = await in_thread(lambda: zenoh.open(terms), "zenoh open")
    except zenoh.ZError as error:
        raise config.start_error(reason_of(error)) from None
    return OpenSession(zenoh, session, config, settings)


async def open_trusted_session(settings: Settings) -> OpenSession:
    """Open the session that the settings ask for.

    Raises:
        StartError: It may not be opened without certificates, an address is taken, or no router answers.
    """
    return await open_session(session_config(settings), settings)
