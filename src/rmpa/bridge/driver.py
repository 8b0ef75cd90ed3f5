"""Drives the parts: looks at the local graph in portions, and carries requests between agents.

Drives the plans of topics, or of services, in small slices, so that data goes first.
"""

from __future__ import annotations

import asyncio
import functools
import inspect
import itertools
import logging
import time
from collections import OrderedDict, deque
from collections.abc import Awaitable, Callable
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, Generic, Protocol, TypeVar

import msgspec

from rmpa.bridge import limits
from rmpa.bridge.actions import Pacing, Send, Warn
from rmpa.bridge.messages import Notification, Request, Response, decode, encode, with_text, without_text
from rmpa.bridge.services.bodies import BodyReceiver, BodySender, Budget
from rmpa.bridge.sessions import Part
from rmpa.core.counters import logged_failure
from rmpa.core.errors import LimitExceeded, PeerRefused, RemoteProtocolError, RmpaError, UnreachableError
from rmpa.core.limits import UINT32_MAX
from rmpa.runtime.loop import MachineTimer, yield_to_data

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from rmpa.bridge.messages import Message
    from rmpa.bridge.policy import Needs
    from rmpa.bridge.sessions import PeerSession, PeerSessions
    from rmpa.core.counters import Counters, RefusalLog

_log = logging.getLogger(__name__)

ActionT = TypeVar("ActionT")
AdvertisementT = TypeVar("AdvertisementT")
_ActionT_co = TypeVar("_ActionT_co", covariant=True)


class ExportPlan(Protocol[_ActionT_co]):
    """Decides what of the local graph is advertised to peers."""

    @property
    def pending(self) -> bool:
        """Whether a peer has not received all changes yet."""
        ...

    def advertise(self, ready: Callable[[int], bool]) -> Sequence[_ActionT_co]:
        """Return the actions of the next advertisement, at most one for each ready peer."""
        ...


class ImportPlan(Protocol[_ActionT_co]):
    """Decides what of the peers appears in the local graph."""

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is due, monotonic seconds; ``None`` if no timer runs."""
        ...

    def handle_timer(self, now: float) -> Sequence[_ActionT_co]:
        """Handle due timers; return the actions to carry out."""
        ...


class GraphDriver(Generic[ActionT, AdvertisementT]):
    """Passes changes to two plans and carries out their actions, a slice in each turn of the event loop.

    A graph of thousands of names must not delay a message. Names to look at, advertisements to apply, entries to
    judge by new rules and actions to carry out are therefore queued, and data may be handled between any two of them.

    Args:
        sessions: Finds the peer of an action.
        refusals: Logs and counts the warnings of the plans, and peers that break the protocol.
        exports: The outbound plan.
        imports: The inbound plan.
        look_at: Passes the present state of these names in the local graph to the plans. Data may be handled between
            two names.
        advertisement: The type of the peers' advertisements.
        apply: Splits a parsed advertisement into portions; each item that is taken applies one, and is its actions.
        do: Carries out an action that is neither ``Send`` nor ``Warn``.
        is_urgent: Whether an action is carried out at once, before those that wait.
        on_idle: Called when nothing is left to do after a change.
    """

    def __init__(
        self,
        sessions: PeerSessions,
        refusals: RefusalLog,
        *,
        exports: ExportPlan[ActionT],
        imports: ImportPlan[ActionT],
        look_at: Callable[[Iterable[str]], None],
        advertisement: type[AdvertisementT],
        apply: Callable[[PeerSession, AdvertisementT], Iterator[Sequence[ActionT]]],
        do: Callable[[ActionT], None],
        is_urgent: Callable[[ActionT], bool] = lambda _: False,
        on_idle: Callable[[], None] = lambda: None,
    ) -> None:
        self._sessions = sessions
        self._refusals = refusals
        self._exports = exports
        self._look_at = look_at
        self._advertisement = advertisement
        self._apply = apply
        self._do = do
        self._is_urgent = is_urgent
        self._on_idle = on_idle
        # Ordered: in a plain dict, taking the first item skips over the places of all items taken before.
        self._changed: OrderedDict[str, None] = OrderedDict()
        self._advertisements: deque[tuple[PeerSession, bytes | Iterator[Sequence[ActionT]]]] = deque()
        self._unread_bytes = 0
        self._rejudging: Iterator[Sequence[ActionT]] = iter(())
        self._freeing: deque[Iterator[object]] = deque()
        self._actions: deque[ActionT] = deque()
        self._acting = False
        self._pacing = Pacing()
        self._scan_handle: asyncio.Handle | None = None
        self._timer = MachineTimer(imports.next_timer, lambda now: self.act(imports.handle_timer(now)))
        self._closed = False

    @property
    def idle(self) -> bool:
        """Whether all changes of the local graph have been passed to the plans."""
        return not self._changed

    def close(self) -> None:
        """Stop all slices and the timer; ``act`` still carries out actions."""
        self._closed = True
        self._timer.close()
        if self._scan_handle is not None:
            self._scan_handle.cancel()

    # --- what there is to do ---------------------------------------------------------------------------------------

    def look(self, names: Iterable[str]) -> None:
        """Queue names under which the local graph may have changed."""
        self._changed |= dict.fromkeys(names)
        self.schedule()

    def advertised(self, session: PeerSession, payload: bytes) -> None:
        """Queue a peer's advertisement. Parsing takes long, so it is done later, unless too many bytes wait.

        Raises:
            LimitExceeded: It is longer than ``limits.ADVERTISEMENT_MAX``.
        """
        if len(payload) > limits.ADVERTISEMENT_MAX:
            raise LimitExceeded("advertisement", len(payload), limits.ADVERTISEMENT_MAX)
        self._advertisements.append((session, payload))
        self._unread_bytes += len(payload)
        self.schedule()
        while self._unread_bytes > limits.ADVERTISED_WAITING_BYTES:
            self._apply_next()

    def rejudge(self, judged: Iterator[Sequence[ActionT]]) -> None:
        """Take the actions of ``judged`` a portion at a time, instead of the rest of an earlier iterator."""
        self._rejudging = judged
        self.schedule()

    def free(self, items: Iterator[object]) -> None:
        """Take these items a portion at a time and drop them: freeing thousands at once takes long."""
        self._freeing.append(items)
        self.schedule()

    def link_down(self, session: PeerSession) -> None:
        """Drop a peer's advertisements that are not applied yet, since its link is gone."""
        self._advertisements = deque(one for one in self._advertisements if one[0] is not session)
        self._unread_bytes = sum(len(waiting) for _, waiting in self._advertisements if isinstance(waiting, bytes))

    def waits(self, session: PeerSession) -> bool:
        """Whether an advertisement of a peer is not applied yet."""
        return any(one is session for one, _ in self._advertisements)

    def gone(self, session: PeerSession) -> None:
        """Forget the pacing of a session that has ended."""
        self._pacing.forget(session.peer)

    # --- a slice of it ----------------------------------------------------------------------------------------

    def schedule(self) -> None:
        """Do a slice of the queued work in the next turn of the loop."""
        if self._scan_handle is None and not self._closed:
            self._scan_handle = asyncio.get_running_loop().call_soon(self._scan)

    def _scan(self) -> None:
        self._scan_handle = None
        try:
            self._do_slice()
        except Exception:  # noqa: BLE001 - the rest must not wait for the next change
            _log.exception("! a slice of work failed; the rest goes on")
            if self._changed or self._advertisements or self._freeing:  # of which each slice takes some: it ends
                self.schedule()

    def _do_slice(self) -> None:
        self._look_at(self._next_names())
        told = self._exports.advertise(self._may_tell)
        self.act(told)
        if self._advertisements:
            self._apply_next()
        if self._freeing and not tuple(islice(self._freeing[0], limits.APPLIED_AT_ONCE)):
            self._freeing.popleft()
        rejudged = tuple(islice(self._rejudging, limits.APPLIED_AT_ONCE))
        # In one call: actions from data that is handled in between have to follow all of these.
        self.act([action for actions in rejudged for action in actions])
        if self._changed or self._advertisements or self._freeing or rejudged or (told and self._exports.pending):
            self.schedule()
        elif self._exports.pending:
            self._schedule_later()
        else:
            self._on_idle()

    def _next_names(self) -> Iterator[str]:
        for _ in range(min(len(self._changed), limits.RESCANNED_AT_ONCE)):
            name, _ = self._changed.popitem(last=False)
            yield_to_data()
            yield name

    def _schedule_later(self) -> None:
        """Schedules the next advertisements after ``limits.TELL_PAUSE``: earlier ones are still on their way."""
        if self._scan_handle is None and not self._closed:
            self._scan_handle = asyncio.get_running_loop().call_later(limits.TELL_PAUSE, self._scan)

    def _may_tell(self, peer: int) -> bool:
        session = self._sessions.get(peer)
        busy = session is not None and session.link.busy
        return self._pacing.ready(peer, asyncio.get_running_loop().time(), busy=busy)

    def _apply_next(self) -> None:
        """Parses the advertisement that has waited longest, or applies its next portion if it is parsed."""
        session, waiting = self._advertisements.popleft()
        if not isinstance(waiting, bytes):
            if (actions := next(waiting, None)) is not None:
                self._advertisements.appendleft((session, waiting))
                self.act(actions)
            return
        self._unread_bytes -= len(waiting)
        try:
            message = decode(waiting)
        except RemoteProtocolError as error:
            self.refuse(session, error)
            return
        if isinstance(message, self._advertisement):
            self._advertisements.appendleft((session, self._apply(session, message)))

    def refuse(self, session: PeerSession, error: RemoteProtocolError) -> None:
        """Log that a peer broke the protocol, and close its link."""
        text = f"{session.link.name} broke the protocol: {error}"
        self.warn("link.malformed", session.link.remote_endpoint[0], text)
        session.link.abort(text)

    # --- actions ----------------------------------------------------------------------------------------------

    def act(self, actions: Iterable[ActionT]) -> None:
        """Carry out actions after those that wait; data handled in between may add further ones."""
        for action in actions:
            if self._is_urgent(action):
                self._carry_out(action)
            else:
                self._actions.append(action)
        if self._acting:
            return
        self._acting = True
        try:
            while self._actions:
                action = self._actions.popleft()
                with logged_failure(_log, "%s failed; what follows goes on", action):
                    self._carry_out(action)
                yield_to_data()
        finally:
            self._acting = False
        self._timer.arm()

    def _carry_out(self, action: ActionT) -> None:
        if isinstance(action, Warn):
            self.warn(action.kind, action.who, action.text)
        elif isinstance(action, Send):
            session = self._sessions.get(action.peer)
            if session is not None and session.linked:
                session.link.send_control(encode(action.message))
        else:
            self._do(action)

    def warn(self, kind: str, who: str, text: str) -> None:
        """Log a warning about ``who`` and count it as ``kind``; repeated ones are only counted."""
        self._refusals.refuse(asyncio.get_running_loop().time(), kind, who, text)


# Requests, responses and notifications between agents, for parameters, ``rmpa why`` and others.
#
# A handler gets the requesting peer and the arguments. It returns a value that JSON can represent, or an awaitable
# of
# one. An ``RmpaError`` that it raises becomes the error of the response.
#
# Small messages take the control lane. A request or response of more than ``limits.ASK_EXPRESS_MAX`` bytes crosses
# as
# the body of a service's call does (``services.io.bodies``), on route 0 of the bulk lane, so that no command waits
# for
# it: 8 bytes with the time until which the requesting agent waits, the message as JSON, and if it has a long
# ``text`` a
# line feed and that.


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
        self._large[session.peer] = session.handlers[_ROUTE] = LargeMessages(session, self._take_large, self._send)

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
