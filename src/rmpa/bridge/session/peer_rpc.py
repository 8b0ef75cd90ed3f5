"""Requests, responses and notifications between agents, for parameters, ``rmpa why`` and others.

A handler gets the requesting peer and the arguments. It returns a value that JSON can represent, or an awaitable of
one. An ``RmpaError`` that it raises becomes the error of the response.
"""

from __future__ import annotations

import asyncio
import functools
import inspect
import itertools
import logging
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.bridge import limits
from rmpa.bridge.messages import Notification, Request, Response, encode
from rmpa.bridge.session.part import Part
from rmpa.core.errors import PeerRefused, RmpaError, UnreachableError
from rmpa.core.sizes import UINT32_MAX
from rmpa.mesh import limits as mesh_limits

if TYPE_CHECKING:
    from rmpa.bridge.messages import Message
    from rmpa.bridge.permission_gate import Needs
    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.core.counters import Counters

_log = logging.getLogger(__name__)

UNKNOWN_QUESTION: Final = "does not know the question"
"""In the response of an agent of an earlier release."""
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
        """
        number = next(self._numbers)
        future: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
        self._waiting[session.peer, number] = (future, session.link.name)
        try:
            session.link.send_control(encode(Request(number, what, args)))
            async with asyncio.timeout(timeout):
                return await future
        except TimeoutError:
            remedy = "is its agent stopped, or its version older?"
            raise UnreachableError("agent", f"{session.link.name} ({what}, {timeout:g} s)", remedy) from None
        finally:
            self._waiting.pop((session.peer, number), None)

    def link_down(self, session: PeerSession) -> None:
        """Fail the requests to a peer whose link is gone, and cancel the handlers of its own requests."""
        for (peer, _), (future, name) in list(self._waiting.items()):
            if peer == session.peer and not future.done():
                future.set_exception(UnreachableError("agent", name, "its link has just ended; try again"))
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

    def _answer(self, session: PeerSession, ask: Request) -> None:
        if session.link.abandoned:
            self._counters.add("ask.late")
            text = "this agent was stopped when the question came, and the asking one has given it up"
            self._send(session, Response(ask.number, ok=False, error=text, remedy="ask again"))
            return
        tasks = self._answering.setdefault(session.peer, set())
        if len(tasks) >= limits.ASKS_AT_ONCE:
            self._send(session, Response(ask.number, ok=False, error="too many questions at once"))
            return
        task = asyncio.create_task(self._respond(session, ask), name=f"answer {ask.what} of {session.link.name}")
        tasks.add(task)
        task.add_done_callback(functools.partial(self._answered, session.peer))

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
        payload = encode(answer)
        if len(payload) > mesh_limits.CONTROL_PAYLOAD_MAX:
            text = f"the answer has {len(payload)} bytes, more than {mesh_limits.CONTROL_PAYLOAD_MAX}"
            payload = encode(Response(answer.number, ok=False, error=text))
        session.link.send_control(payload)
