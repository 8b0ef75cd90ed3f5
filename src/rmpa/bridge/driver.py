"""Drives the plans of topics, or of services, in small slices, so that data goes first."""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict, deque
from itertools import islice
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

from rmpa.bridge import limits
from rmpa.bridge.actions import Pacing, Send, Warn
from rmpa.bridge.messages import decode, encode
from rmpa.core.counters import logged_failure
from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.runtime.loop import MachineTimer, yield_to_data

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from rmpa.bridge.sessions import PeerSession, PeerSessions
    from rmpa.core.counters import RefusalLog

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
