"""Queries in both directions: those that came and wait for their answers, and those that were asked."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

from rmpa.gateway.zenoh_api import ZenohReply

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

    from rmpa.gateway.zenoh.worker import SerialWorker
    from rmpa.ros.wire.tcpros import Buffer


def content(data: Any) -> bytes:
    """The bytes of a payload or an attachment of Zenoh; empty for none."""
    return b"" if data is None else bytes(data.to_bytes())


class ArrivedQuery:
    """A query that has come, and whose answers go out by a thread.

    Args:
        query: Zenoh's query.
        worker: The thread that answers.
    """

    def __init__(self, query: Any, worker: SerialWorker) -> None:
        self._query: Any = query
        self._worker = worker
        self.key = str(query.key_expr)
        self.parameters = str(query.parameters)
        self.payload = content(query.payload)
        self.attachment = content(query.attachment)

    def reply(self, key: str, payload: Buffer, attachment: bytes = b"") -> None:
        """Give one answer; more may follow until ``finish``."""
        query = self._query
        if query is None:
            return
        body = payload if isinstance(payload, bytes) else bytes(payload)
        self._worker.submit(lambda: query.reply(key, body, attachment=attachment or None))

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
    """A query that was asked; collects its answers in Zenoh's threads.

    Args:
        done: Resolved in the event loop with all answers.
        call_loop: Calls a function in the event loop, from any thread.
    """

    def __init__(
        self, done: asyncio.Future[list[ZenohReply]], call_loop: Callable[[Callable[[], None]], None]
    ) -> None:
        self._done = done
        self._call_loop = call_loop
        self._lock = threading.Lock()
        self._replies: list[ZenohReply] = []

    def add(self, reply: Any) -> None:
        """Take one answer. Zenoh's own for a time-out, here or in a router on the way, is left out."""
        sample = reply.ok
        if sample is not None:
            answer = ZenohReply(str(sample.key_expr), content(sample.payload), content(sample.attachment), ok=True)
        elif reply.replier_id is None or not reply.replier_id.eid:
            return  # no queryable has the entity id 0
        else:
            answer = ZenohReply("", content(reply.err.payload), b"", ok=False)
        with self._lock:
            self._replies.append(answer)

    def finish(self) -> None:
        """Resolve with what has come; called from any thread, and again without effect."""
        self._call_loop(self._settle)

    def collected(self) -> list[ZenohReply]:
        """The answers up to now."""
        with self._lock:
            return list(self._replies)

    def _settle(self) -> None:
        if not self._done.done():
            self._done.set_result(self.collected())
