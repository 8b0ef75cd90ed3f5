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
import inspect
import itertools
import logging
import time
from collections.abc import Awaitable, Callable, Iterable
from typing import TYPE_CHECKING, Any, Final, TypeVar

import msgspec

from rmpa.bridge import limits
from rmpa.bridge.messages import Message, Notification, Request, Response, decode, encode, with_text, without_text
from rmpa.bridge.policy import OPEN_GATE, Needs, PermissionGate
from rmpa.bridge.services.bodies import BodyReceiver, BodySender, Budget
from rmpa.bridge.sessions import Part, PeerSession
from rmpa.config.values import suggestion
from rmpa.core.errors import (
    UNKNOWN_QUESTION,
    LimitExceeded,
    PeerRefused,
    RemoteProtocolError,
    RmpaError,
    UnreachableError,
)
from rmpa.core.facts import ModuleAnswer
from rmpa.core.identity import is_meant
from rmpa.core.limits import UINT32_MAX
from rmpa.runtime.tasks import OwnedTasks, end_tasks

if TYPE_CHECKING:
    from rmpa.bridge.bridge import Bridge
    from rmpa.core.statistics import Counters

_log = logging.getLogger(__name__)

# The route of large messages; those of topics and services have numbers above it.
_ROUTE: Final = 0
_UNTIL: Final = 8
_LINK_ENDED: Final = "its link has just ended; try again"
Handler = Callable[["PeerSession", dict[str, Any]], Awaitable[object] | object]
Listener = Callable[["PeerSession", dict[str, Any]], None]


# Of an agent that does not know a question that a later release asks.
EARLIER: Final = "its agent is of an earlier release, which does not know this; install this release there"


_Answer = TypeVar("_Answer", bound=ModuleAnswer)


def gate_for(bridge: Bridge, asker: PeerSession | None) -> tuple[PermissionGate, str]:
    """What decides about the answer to a question, and the peer's name; a program of this module may have all."""
    return (bridge.context.gate, asker.link.name) if asker is not None else (OPEN_GATE, "")


def meant(sessions: Iterable[PeerSession], module: object) -> list[PeerSession]:
    """The peers among these that a user means by a name or a GUID."""
    return [one for one in sessions if is_meant(str(module), one.link.name, str(one.link.guid))]


def no_such_module(module: str, own: str, sessions: Iterable[PeerSession]) -> RmpaError:
    """The error about a name that no linked module has; the nearest one is named."""
    names = [own, *(one.link.name for one in sessions)]
    near = suggestion(module, names, "`rmpa peer list` shows which modules are there")
    return RmpaError(f"no linked module has this name; {near}", code="unknown-name")


class PeerRpc(Part):
    """Sends requests to the peers, and responds to theirs.

    Args:
        counters: Counts ``ask.failed`` and ``ask.late``.
    """

    def __init__(self, counters: Counters) -> None:
        self.counters = counters
        self.handlers: dict[str, Handler] = {}
        self._listeners: dict[str, Listener] = {}
        self._links: dict[int, LinkRequests] = {}

    def on_request(self, what: str, handler: Handler, _needs: Needs) -> None:
        """Set the handler of the requests named ``what``, which asks for the permissions that ``_needs`` declares."""
        self.handlers[what] = handler

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
        link = self._links.get(session.peer)
        if link is None:
            raise UnreachableError("agent", session.link.name, _LINK_ENDED)
        return await link.request(what, args, timeout)

    async def ask(
        self,
        session: PeerSession,
        what: str,
        args: dict[str, Any],
        answer: type[_Answer],
        timeout: float = limits.ASK_TIMEOUT,  # noqa: ASYNC109 - as of ``request``
    ) -> _Answer:
        """Send a request to a peer as ``request`` does, and return its answer, or one that says why there is none."""
        try:
            value = await self.request(session, what, args, timeout)
            return msgspec.structs.replace(msgspec.convert(value, answer), module=session.link.name)
        except msgspec.ValidationError as error:
            problem, code = f"its answer is malformed: {error}", "protocol-error"
        except PeerRefused as error:
            problem, code = (EARLIER, "other-release") if error.unknown else (error.reason, "not-permitted")
        except RmpaError as error:
            problem, code = str(error), error.code
        return answer(module=session.link.name, problem=problem, code=code)

    def link_up(self, session: PeerSession) -> None:
        """Take the large messages of a linked peer."""
        self._links[session.peer] = session.link.routes[_ROUTE] = LinkRequests(self, session)

    def lane_lost(self, session: PeerSession) -> None:
        """Fail the requests to a peer that lost the bulk lane: it is unknown which were on it, or their responses."""
        link = self._links[session.peer]
        link.drop("the connection for large messages was lost")
        link.fail("its connection for large messages has just ended; try again")

    def link_down(self, session: PeerSession) -> None:
        """Fail the requests to a peer whose link is gone, and cancel the handlers of its own requests."""
        if (link := self._links.pop(session.peer, None)) is not None:
            link.close()

    def depends(self, session: PeerSession) -> bool:
        """Whether a request to or from a peer waits for its response."""
        link = self._links.get(session.peer)
        return link is not None and bool(link.waiting or link.tasks)

    def message(self, session: PeerSession, message: Message) -> bool:
        """Take a request, a response or a notification."""
        if isinstance(message, Request | Response):
            self._links[session.peer].take(message)
        elif not isinstance(message, Notification):
            return False
        elif (listener := self._listeners.get(message.what)) is not None:
            listener(session, message.args)
        return True

    async def close(self) -> None:
        """Cancel all handlers that are running."""
        await end_tasks(*(task for link in self._links.values() for task in link.tasks))


class LinkRequests(BodyReceiver):
    """The requests over one link, in both directions, and its large messages.

    Args:
        rpc: Has the handlers.
        session: The peer.

    Attributes:
        waiting: The requests to the peer that have no response yet, by number.
        tasks: The handlers of the peer's requests.
    """

    def __init__(self, rpc: PeerRpc, session: PeerSession) -> None:
        super().__init__(Budget(limits.ASK_BYTES), limits.ASK_BYTES_MAX + _UNTIL)
        self._rpc = rpc
        self._session = session
        self._link = session.link
        self._sender = BodySender(session.link, _ROUTE)
        self._outgoing = Budget(limits.ASK_BYTES)
        self._numbers = itertools.cycle(range(1, UINT32_MAX + 1))
        self.waiting: dict[int, asyncio.Future[Any]] = {}
        self.tasks = OwnedTasks()

    async def request(self, what: str, args: dict[str, Any], timeout: float) -> Any:  # noqa: ASYNC109 - as above
        """Send a request, and return the value of its response; errors as ``PeerRpc.request``."""
        number = next(self._numbers)
        future = self.waiting[number] = asyncio.get_running_loop().create_future()
        try:
            self._post(Request(number, what, args), timeout)
            async with asyncio.timeout(timeout):
                return await future
        except TimeoutError:
            remedy = "is its agent stopped, or its version older?"
            raise UnreachableError("agent", f"{self._link.name} ({what}, {timeout:g} s)", remedy) from None
        finally:
            del self.waiting[number]

    def fail(self, remedy: str) -> None:
        """Fail the requests to the peer."""
        for future in self.waiting.values():
            if not future.done():
                future.set_exception(UnreachableError("agent", self._link.name, remedy))

    def close(self) -> None:
        """End everything: the link is gone."""
        self._sender.close()
        self.fail(_LINK_ENDED)
        for task in self.tasks:
            task.cancel()

    def body(self, sequence: int, body: bytes | bytearray) -> None:  # noqa: ARG002 - the message has its own number
        """Take a large message.

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
        late = 0.0
        if clock.error_ns is not None:
            now = time.time_ns() + clock.ahead_ns - clock.error_ns
            late = (now - int.from_bytes(view[:_UNTIL], "little")) / 1e9
        self.take(message, late, len(body))

    def failed(self, sequence: int, reason: str) -> None:
        """Respond to a request of which the rest was lost; a lost response has the requesting agent's time-out."""
        if sequence:
            self._refuse(sequence, f"the question was lost: {reason}")

    def take(self, message: Request | Response, late: float = 0.0, size: int = 0) -> None:
        """Take a request or a response.

        Args:
            message: The message.
            late: For how many seconds at least the peer has not waited for a response any more; at most 0: it waits.
            size: The bytes of a large message; those of a request count in the budget while it is answered.
        """
        if isinstance(message, Response):
            future = self.waiting.get(message.number)
            if future is not None and not future.done():
                if message.ok:
                    future.set_result(message.value)
                else:
                    future.set_exception(PeerRefused(self._link.name, message.error, message.remedy))
        elif late > 0:
            self._rpc.counters.add("ask.late")
            text = f"the question came {late:.1f} s after the asking agent had given it up"
            self._refuse(message.number, text, "ask again")
        elif len(self.tasks) >= limits.ASKS_AT_ONCE:
            self._refuse(message.number, "too many questions at once")
        elif not self._budget.take(size):
            self._refuse(message.number, "too many large questions at once")
        else:
            task = self.tasks.start(self._respond(message), f"answer {message.what} of {self._link.name}")
            task.add_done_callback(lambda _: self._budget.give(size))

    async def _respond(self, ask: Request) -> None:
        proven = asyncio.Event()
        self._link.when_proven(proven.set)
        await proven.wait()
        handler = self._rpc.handlers.get(ask.what)
        if handler is None:
            text = f"this agent {UNKNOWN_QUESTION} {ask.what!r}"
            self._refuse(ask.number, text, "install the same release on both")
            return
        try:
            value = handler(self._session, ask.args)
            if inspect.isawaitable(value):
                value = await value
            self._send(Response(ask.number, ok=True, value=msgspec.to_builtins(value)))
        except RmpaError as error:
            self._refuse(ask.number, str(error)[: limits.CONTROL_TEXT_MAX])
        except Exception:
            self._rpc.counters.add("ask.failed")
            self._refuse(ask.number, f"the agent failed at {ask.what}", "its log says why")
            raise

    def _refuse(self, number: int, error: str, remedy: str = "") -> None:
        self._send(Response(number, ok=False, error=error, remedy=remedy))

    def _send(self, answer: Response) -> None:
        try:
            self._post(answer)
        except LimitExceeded as error:
            self._post(Response(answer.number, ok=False, error=f"the answer cannot be sent: {error}"))

    def _post(self, message: Request | Response, wait: float = 0.0) -> None:
        """Send a message; the peer does not act on a large request that comes after ``wait`` seconds."""
        fields = message.args if isinstance(message, Request) else message.value
        short, text = without_text(fields)
        if text:
            named = {"args": short} if isinstance(message, Request) else {"value": short}
            body = b"\n".join((encode(msgspec.structs.replace(message, **named)), text))
        elif len(body := encode(message)) <= limits.ASK_EXPRESS_MAX:
            self._link.send_control(body)
            return
        if len(body) > limits.ASK_BYTES_MAX:
            raise LimitExceeded("message between agents", len(body), limits.ASK_BYTES_MAX)
        if not self._outgoing.take(len(body)):
            raise LimitExceeded("waiting messages between agents", self._outgoing.used, self._outgoing.limit)
        until = time.time_ns() + round(wait * 1e9)
        number = message.number if isinstance(message, Request) else 0
        self._sender.send(number, body, until.to_bytes(_UNTIL, "little"), self._outgoing)
