"""Requests, responses and notifications between agents, for parameters, ``rmpa why`` and others.

A handler gets the requesting peer and the arguments. It returns a value that JSON can represent, or an awaitable of
one. An ``RmpaError`` that it raises becomes the error of the response.

Small messages take the control lane. A request or response of more than ``limits.ASK_EXPRESS_MAX`` bytes crosses as
the body of a service's call does (``services.bodies``), on route 0 of the bulk lane, so that no command waits for it:
8 bytes with the time until which the requesting agent waits, the message as JSON, and if it has a long ``text`` a
line feed and that.
"""

from __future__ import annotations

import asyncio
import functools
import inspect
import itertools
import logging
import time
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.bridge import limits
from rmpa.bridge.messages import Notification, Request, Response, decode, encode, with_text, without_text
from rmpa.bridge.services.bodies import BodyReceiver, BodySender, Budget
from rmpa.bridge.sessions import Part
from rmpa.core.errors import LimitExceeded, PeerRefused, RemoteProtocolError, RmpaError, UnreachableError
from rmpa.core.limits import UINT32_MAX

if TYPE_CHECKING:
    from rmpa.bridge.messages import Message
    from rmpa.bridge.policy import Needs
    from rmpa.bridge.sessions import PeerSession
    from rmpa.core.counters import Counters

_log = logging.getLogger(__name__)

UNKNOWN_QUESTION: Final = "does not know the question"
"""In the response of an agent of an earlier release."""
_ROUTE: Final = 0
"""The route of large messages; those of topics and services have numbers above it."""
_UNTIL: Final = 8
Handler = Callable[["PeerSession", dict[str, Any]], Awaitable[object] | object]
Listener = Callable[["PeerSession", dict[str, Any]], None]


class PeerRpc(Part):
    """Sends requests to the peers, and responds to theirs.

    Args:
        counters: Counts ``ask.failed`` and ``ask.late``.
    """

    def __init__(self, counters: Counters) -> None:
        self._counters = counters
        self._numbers = itertools.cycle(range(1, UINT32_MAX + 1))
        self._waiting: dict[tuple[int, int], tuple[asyncio.Future[Any], str]] = {}
        self._handlers: dict[str, Handler] = {}
        self._listeners: dict[str, Listener] = {}
        self._answering: dict[int, set[asyncio.Task[None]]] = {}
        self._large: dict[int, LargeMessages] = {}

    def on_request(self, what: str, handler: Handler, _needs: Needs) -> None:
        """Set the handler of the requests named ``what``, which asks for the permissions that ``_needs`` declares."""
        self._handlers[what] = handler

    def on_notification(self, what: str, listener: Listener, _needs: Needs) -> None:
        """Set the listener for the notifications named ``what``; ``_needs`` as of ``on_request``."""
        self._listeners[what] = listener

    def notify(self, session: PeerSession, what: str, args: dict[str, Any]) -> None:
        """Send a notification to a linked peer."""
        session.link.send_control(encode(Notification(what, args)))

    async def request(
        self,
        session: PeerSession,
        what: str,
        args: dict[str, Any],
        timeout: float = limits.ASK_TIMEOUT,  # noqa: ASYNC109 - the message names it
    ) -> Any:
        """Send a request to a linked peer, and return the value of its response.

        Raises:
            PeerRefused: The peer responds with an error.
            UnreachableError: The peer does not respond within ``timeout`` seconds, or its link ends meanwhile.
            LimitExceeded: The request is too large, or too much waits for the link.
        """
        number = next(self._numbers)
        future: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
        self._waiting[session.peer, number] = (future, session.link.name)
        try:
            self._post(session, Request(number, what, args), timeout)
            async with asyncio.timeout(timeout):
                return await future
        except TimeoutError:
            remedy = "is its agent stopped, or its version older?"
            raise UnreachableError("agent", f"{session.link.name} ({what}, {timeout:g} s)", remedy) from None
        finally:
            self._waiting.pop((session.peer, number), None)

    def link_up(self, session: PeerSession) -> None:
        """Take the large messages of a linked peer."""
        self._large[session.peer] = session.link.routes[_ROUTE] = LargeMessages(session, self._take_large, self._send)

    def lane_lost(self, session: PeerSession) -> None:
        """Fail the requests to a peer that lost the bulk lane: it is unknown which were on it, or their responses."""
        self._large[session.peer].drop("the connection for large messages was lost")
        self._fail(session, "its connection for large messages has just ended; try again")

    def _fail(self, session: PeerSession, remedy: str) -> None:
        for (peer, _), (future, name) in list(self._waiting.items()):
            if peer == session.peer and not future.done():
                future.set_exception(UnreachableError("agent", name, remedy))

    def link_down(self, session: PeerSession) -> None:
        """Fail the requests to a peer whose link is gone, and cancel the handlers of its own requests."""
        if (large := self._large.pop(session.peer, None)) is not None:
            large.sender.close()
        self._fail(session, "its link has just ended; try again")
        for task in self._answering.pop(session.peer, ()):
            task.cancel()

    def depends(self, session: PeerSession) -> bool:
        """Whether a request to or from a peer waits for its response."""
        return session.peer in self._answering or any(peer == session.peer for peer, _ in self._waiting)

    def message(self, session: PeerSession, message: Message) -> bool:
        """Take a request, a response or a notification."""
        match message:
            case Request():
                self._answer(session, message)
            case Response():
                future, name = self._waiting.get((session.peer, message.number), (None, ""))
                if future is not None and not future.done():
                    if message.ok:
                        future.set_result(message.value)
                    else:
                        future.set_exception(PeerRefused(name, message.error, message.remedy))
            case Notification():
                if (listener := self._listeners.get(message.what)) is not None:
                    listener(session, message.args)
            case _:
                return False
        return True

    async def close(self) -> None:
        """Cancel all handlers that are running."""
        tasks = [task for tasks in self._answering.values() for task in tasks]
        self._answering.clear()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def _take_large(self, session: PeerSession, message: Message, late: float, budget: Budget, size: int) -> None:
        """Take a large message; its bytes count in ``budget`` while it is a request that is being answered."""
        if not isinstance(message, Request):
            self.message(session, message)
        elif late > 0:
            self._counters.add("ask.late")
            text = f"the question came {late:.1f} s after the asking agent had given it up"
            self._send(session, Response(message.number, ok=False, error=text, remedy="ask again"))
        elif not budget.take(size):
            self._send(session, Response(message.number, ok=False, error="too many large questions at once"))
        elif (task := self._answer(session, message)) is None:
            budget.give(size)
        else:
            task.add_done_callback(lambda _: budget.give(size))

    def _answer(self, session: PeerSession, ask: Request) -> asyncio.Task[None] | None:
        if session.link.abandoned:
            self._counters.add("ask.late")
            text = "this agent was stopped when the question came, and the asking one has given it up"
            self._send(session, Response(ask.number, ok=False, error=text, remedy="ask again"))
            return None
        tasks = self._answering.setdefault(session.peer, set())
        if len(tasks) >= limits.ASKS_AT_ONCE:
            self._send(session, Response(ask.number, ok=False, error="too many questions at once"))
            return None
        task = asyncio.create_task(self._respond(session, ask), name=f"answer {ask.what} of {session.link.name}")
        tasks.add(task)
        task.add_done_callback(functools.partial(self._answered, session.peer))
        return task

    def _answered(self, peer: int, task: asyncio.Task[None]) -> None:
        tasks = self._answering.get(peer, set())
        tasks.discard(task)
        if not tasks:
            self._answering.pop(peer, None)

    async def _respond(self, session: PeerSession, ask: Request) -> None:
        handler = self._handlers.get(ask.what)
        if handler is None:
            text = f"this agent {UNKNOWN_QUESTION} {ask.what!r}"
            self._send(session, Response(ask.number, ok=False, error=text, remedy="install the same release on both"))
            return
        try:
            value = handler(session, ask.args)
            if inspect.isawaitable(value):
                value = await value
            answer = Response(ask.number, ok=True, value=msgspec.to_builtins(value))
        except RmpaError as error:
            answer = Response(ask.number, ok=False, error=str(error)[: limits.CONTROL_TEXT_MAX])
        except Exception:  # noqa: BLE001 - a task's top: one question must not end the link
            self._counters.add("ask.failed")
            _log.exception("! a question of %s failed: %s", session.link.name, ask.what[: limits.ASK_NAME_MAX])
            answer = Response(
                ask.number, ok=False, error=f"the agent failed at {ask.what}", remedy="its log says why"
            )
        self._send(session, answer)

    def _send(self, session: PeerSession, answer: Response) -> None:
        try:
            self._post(session, answer)
        except LimitExceeded as error:
            self._post(session, Response(answer.number, ok=False, error=f"the answer cannot be sent: {error}"))

    def _post(self, session: PeerSession, message: Request | Response, wait: float = 0.0) -> None:
        """Send a message; the peer does not act on a large request that comes after ``wait`` seconds."""
        fields = message.args if isinstance(message, Request) else message.value
        short, text = without_text(fields)
        if text:
            named = {"args": short} if isinstance(message, Request) else {"value": short}
            body = b"\n".join((encode(msgspec.structs.replace(message, **named)), text))
        elif len(body := encode(message)) <= limits.ASK_EXPRESS_MAX:
            session.link.send_control(body)
            return
        if len(body) > limits.ASK_BYTES_MAX:
            raise LimitExceeded("message between agents", len(body), limits.ASK_BYTES_MAX)
        large = self._large.get(session.peer)
        if large is None:
            return  # its link is gone
        if not large.outgoing.take(len(body)):
            raise LimitExceeded("waiting messages between agents", large.outgoing.used, large.outgoing.limit)
        until = time.time_ns() + round(wait * 1e9)
        number = message.number if isinstance(message, Request) else 0
        large.sender.send(number, body, until.to_bytes(_UNTIL, "little"), large.outgoing)


class LargeMessages(BodyReceiver):
    """The large requests and responses of one link.

    Args:
        session: The peer.
        take: ``(session, message, late, budget, size)``: takes a message. ``late``: for how many seconds at least the
            peer has not waited any more; at most 0 if it may still wait.
        send: Sends the response to a request that was lost.
    """

    def __init__(
        self,
        session: PeerSession,
        take: Callable[[PeerSession, Message, float, Budget, int], None],
        send: Callable[[PeerSession, Response], None],
    ) -> None:
        super().__init__(Budget(limits.ASK_BYTES), limits.ASK_BYTES_MAX + _UNTIL)
        self._session = session
        self._take = take
        self._respond = send
        self.sender = BodySender(session.link, _ROUTE)
        self.outgoing = Budget(limits.ASK_BYTES)

    def body(self, sequence: int, body: bytes | bytearray) -> None:  # noqa: ARG002 - the message has its own number
        """Take a message.

        Raises:
            RemoteProtocolError: It is none; the caller closes the link.
        """
        end = body.find(b"\n", _UNTIL)
        view = memoryview(body)
        message = decode(view[_UNTIL:end] if end >= 0 else view[_UNTIL:])
        if not isinstance(message, Request | Response):
            raise RemoteProtocolError("a large message is neither a request nor a response")
        if end >= 0:
            with_text(message.args if isinstance(message, Request) else message.value, view[end + 1 :])
        clock = self._session.time
        late = -1.0
        if clock.error_ns is not None:
            now = time.time_ns() + clock.ahead_ns - clock.error_ns
            late = (now - int.from_bytes(view[:_UNTIL], "little")) / 1e9
        self._take(self._session, message, late, self._budget, len(body))

    def failed(self, sequence: int, reason: str) -> None:
        """Respond to a request of which the rest was lost; a lost response has the requesting agent's time-out."""
        if sequence:
            self._respond(self._session, Response(sequence, ok=False, error=f"the question was lost: {reason}"))
