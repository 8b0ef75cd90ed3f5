"""Queries in both directions: those that came and wait for their answers, and those that were asked."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any, Final

from rmpa.gateway.zenoh import limits
from rmpa.gateway.zenoh_api import ZenohReply

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

    from rmpa.gateway.zenoh.worker import SerialWorker
    from rmpa.ros.wire.tcpros import Buffer


_BUSY: Final = "too many answers wait at this gateway; ask again later"


def content(data: Any) -> bytes:
    """The bytes of a payload or an attachment of Zenoh; empty for none."""
    return b"" if data is None else bytes(data.to_bytes())


class AnswerBudget:
    """What waits in memory for Zenoh to take it: a client that does not read its answers holds them all up.

    Args:
        refuse: Counts an answer that found no room, by its reason; called from any thread.
    """

    def __init__(self, refuse: Callable[[str], None]) -> None:
        self._refuse = refuse
        self._lock = threading.Lock()
        self._answers = self._bytes = 0

    def take(self, size: int) -> bool:
        """Reserve room for an answer of ``size`` bytes; one alone always has it."""
        with self._lock:
            full = self._answers >= limits.ANSWERS_WAITING_MAX or self._bytes + size > limits.ANSWER_BYTES_MAX
            if not (self._answers and full):
                self._answers += 1
                self._bytes += size
                return True
        self._refuse("zenoh.answer.limit")
        return False

    def free(self, size: int) -> None:
        """Give the room back, once Zenoh has the answer."""
        with self._lock:
            self._answers -= 1
            self._bytes -= size


class ArrivedQuery:
    """A query that has come, and whose answers go out by a thread.

    Args:
        query: Zenoh's query.
        worker: The thread that answers.
        budget: Room for the answers that wait.
    """

    def __init__(self, query: Any, worker: SerialWorker, budget: AnswerBudget) -> None:
        self._query: Any = query
        self._worker = worker
        self._budget = budget
        self.key = str(query.key_expr)
        self.parameters = str(query.parameters)
        self.payload = content(query.payload)
        self.attachment = content(query.attachment)

    def reply(self, key: str, payload: Buffer, attachment: bytes = b"") -> None:
        """Give one answer; more may follow until ``finish``."""
        query = self._query
        if query is None:
            return
        if not self._budget.take(len(payload)):
            self.reply_error(_BUSY)
            return
        body = payload if isinstance(payload, bytes) else bytes(payload)
        self._worker.submit(lambda: self._give(query, key, body, attachment))

    def _give(self, query: Any, key: str, body: bytes, attachment: bytes) -> None:
        try:
            query.reply(key, body, attachment=attachment or None)
        finally:
            self._budget.free(len(body))

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
        call_loop: Calls a function in the event loop, from any thread.
        refuse: Counts an answer that is dropped, by its reason; called from any thread.
    """

    def __init__(
        self,
        done: asyncio.Future[list[ZenohReply]],
        call_loop: Callable[[Callable[[], None]], None],
        refuse: Callable[[str], None],
    ) -> None:
        self._done = done
        self._call_loop = call_loop
        self._refuse = refuse
        self._lock = threading.Lock()
        self._replies: list[ZenohReply] = []
        self._bytes = 0
        self._full = False

    @property
    def unfinished(self) -> bool:
        """Whether it was resolved because there were too many answers, and more may come."""
        return self._full

    def add(self, reply: Any) -> None:
        """Take one answer. Zenoh's own for a time-out, here or in a router on the way, is left out."""
        if self._full:
            self._refuse("zenoh.reply.limit")
            return
        sample = reply.ok
        if sample is not None:
            if sample.attachment is not None and len(sample.attachment) > limits.ATTACHMENT_MAX:
                self._refuse("zenoh.attachment.long")
                return
            answer = ZenohReply(str(sample.key_expr), content(sample.payload), content(sample.attachment), ok=True)
        elif reply.replier_id is None or not reply.replier_id.eid:
            return  # no queryable has the entity id 0
        else:
            answer = ZenohReply("", content(reply.err.payload), b"", ok=False)
        size = len(answer.payload) + len(answer.attachment) + len(answer.key)
        with self._lock:
            self._full = bool(self._replies) and (
                len(self._replies) >= limits.REPLIES_MAX or self._bytes + size > limits.REPLY_BYTES_MAX
            )
            if not self._full:
                self._bytes += size
                self._replies.append(answer)
                return
        self._refuse("zenoh.reply.limit")
        self.finish()

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
