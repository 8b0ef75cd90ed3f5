"""Queries in both directions: those that came and wait for their answers, and those that were asked.

What may block (declarations, queries and replies wait for a full transport) runs in a thread, ``SerialWorker``.
"""

from __future__ import annotations

import logging
import queue
import threading
from typing import TYPE_CHECKING, Any, Final

from rmpa.gateway import limits
from rmpa.gateway.zenoh.threads import ZenohReply

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

    from rmpa.gateway.zenoh.threads import Arrivals
    from rmpa.ros.wire.tcpros import Buffer

_log = logging.getLogger(__name__)
_BUSY: Final = "too many answers wait at this gateway; ask again later"


class SerialWorker:
    """Runs functions one after the other in a daemon thread, in the order in which they were given.

    Args:
        name: The thread's name.
    """

    def __init__(self, name: str) -> None:
        self._jobs: queue.SimpleQueue[Callable[[], object] | None] = queue.SimpleQueue()
        self._discard = False
        self.thread = threading.Thread(target=self._run, name=name, daemon=True)
        self.thread.start()

    def submit(self, job: Callable[[], object]) -> None:
        """Run ``job`` after all that was given before; its errors are logged."""
        self._jobs.put(job)

    def stop(self, *, discard: bool = False) -> None:
        """End the thread once all that was given has run.

        Args:
            discard: What has not begun is not run.
        """
        self._discard = discard
        self._jobs.put(None)

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                if not self._discard:
                    job()
            except Exception as error:  # noqa: BLE001 - one declaration that fails must not stop the others
                if not self._discard:
                    _log.warning("! zenoh: %s [zenoh-trouble]", error)
            del job


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

    def reply(self, key: str, payload: Buffer, attachment: bytes = b"") -> None:
        """Give one answer; more may follow until ``finish``."""
        query = self._query
        if query is None:
            return
        if not self._arrivals.take_room(len(payload)):
            self.reply_error(_BUSY)
            return
        body = payload if isinstance(payload, bytes) else bytes(payload)
        self._worker.submit(lambda: self._give(query, key, body, attachment))

    def _give(self, query: Any, key: str, body: bytes, attachment: bytes) -> None:
        try:
            query.reply(key, body, attachment=attachment or None)
        finally:
            self._arrivals.free_room(len(body))

    def reply_error(self, text: str) -> None:
        """Answer with an error, and finish."""
        query = self._query
        if query is not None:
            self._worker.submit(lambda: query.reply_err(text))
            self.finish()

    def finish(self) -> None:
        """Say that no more answers come."""
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

    def __init__(self, done: asyncio.Future[list[ZenohReply]], arrivals: Arrivals) -> None:
        self._done = done
        self._arrivals = arrivals
        self._lock = threading.Lock()
        self._replies: list[ZenohReply] = []
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
            answer = ZenohReply(str(sample.key_expr), content(sample.payload), content(sample.attachment), ok=True)
        elif reply.replier_id is None or not reply.replier_id.eid:
            return  # no queryable has the entity id 0
        else:
            answer = ZenohReply("", content(reply.err.payload), b"", ok=False)
        size = len(answer.payload) + len(answer.attachment) + len(answer.key)
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
        self._arrivals.call(self._settle)

    def collected(self) -> list[ZenohReply]:
        """The answers up to now."""
        with self._lock:
            return list(self._replies)

    def _settle(self) -> None:
        if not self._done.done():
            self._done.set_result(self.collected())
