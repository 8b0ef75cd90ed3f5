"""The user's side of direct transport: decides how the nodes of this module reach those of peers.

One task for each path asks the peer's agent, and probes the node that it names. What changes meanwhile begins it
anew, so that no outdated answer is taken.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from rmpa.bridge import limits
from rmpa.bridge.direct.grants import DirectAsk, Want, read_want, write
from rmpa.bridge.direct.nodes import NO_LINK, Condition, Grant, Unmet, read_reply
from rmpa.bridge.policy import OPEN_GATE, PermissionGate
from rmpa.bridge.rpc import UNKNOWN_QUESTION
from rmpa.core.contract import Transport
from rmpa.core.errors import PeerRefused, RemoteProtocolError, RmpaError

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterator

    from rmpa.bridge.rpc import PeerRpc
    from rmpa.bridge.sessions import PeerSession, PeerSessions
    from rmpa.core.contract import Contract
    from rmpa.core.counters import Counters

_log = logging.getLogger(__name__)
_UNSTABLE: Final = Unmet(
    Condition.STABLE,
    f"its direct connection broke {limits.DIRECT_BREAKS} times in {limits.DIRECT_BREAKS_SPAN:g} s",
)


@dataclass(slots=True, eq=False)
class Path:
    """How one local subscriber of a peer's topic, or all local callers of its service, reach the peer's node.

    Args:
        peer: The number of the peer's session.
        want: What is reached.
        wanted: The transport that this module's rules ask for.
        unmet_here: The condition that does not hold here, if any.
        contract: That of the topic here.
        found: The decision; ``None``: there is none yet.
        since: When it was made, monotonic seconds.
        answered: Whether the subscriber was told where to connect, and has not left since.
        answered_at: When, monotonic seconds.
        endpoint: Where that leads; ``None``: to the agents.
        stranded: When the subscriber lost its connection, to be called back; ``None``: it did not.
        stuck: Why its direct connection cannot be ended although it has to be relayed; empty: it can.
        broken: Whether its direct connection ended by itself, which the peer is told with the next question.
        breaks: When its direct connections ended by themselves, monotonic seconds.
        held: Whether the peer may hold a grant for it.
        asked_at: When the peer was last asked, monotonic seconds.
        task: Makes the decision.
        mover: Moves the subscriber.
        retry: Begins to decide again.
        decided: Set while there is a decision, and none is being made.
    """

    peer: int
    want: Want
    wanted: Transport = Transport.AUTO
    unmet_here: Unmet | None = None
    contract: Contract | None = None
    found: Grant | Unmet | None = None
    since: float = 0.0
    answered: bool = False
    answered_at: float = 0.0
    endpoint: tuple[str, int] | None = None
    stranded: float | None = None
    stuck: str = ""
    broken: bool = False
    breaks: deque[float] = field(default_factory=lambda: deque(maxlen=limits.DIRECT_BREAKS))
    held: bool = False
    asked_at: float = -math.inf
    task: asyncio.Task[None] | None = None
    mover: asyncio.Task[None] | None = None
    retry: asyncio.TimerHandle | None = None
    decided: asyncio.Event = field(default_factory=asyncio.Event)

    @property
    def unmet(self) -> Unmet | None:
        """Why it is relayed; ``None`` if it is not, or not decided."""
        return self.found if isinstance(self.found, Unmet) and self.decided.is_set() else None

    @property
    def state(self) -> str:
        """``asking``, ``direct`` or ``relayed``."""
        if not self.decided.is_set():
            return "asking"
        return "direct" if isinstance(self.found, Grant) else "relayed"


class Paths:
    """The decisions of this module. Subclasses probe nodes, and carry the decisions out.

    Args:
        sessions: The peers.
        rpc: Carries the questions.
        on_warning: ``(kind, subject, text)``: logs and counts a warning.
        counters: Count ``direct.failed`` and ``direct.undecided``.
        gate: Whether the mesh is secured.
    """

    kind = ""
    """The middle of the names of the messages."""

    def __init__(
        self,
        sessions: PeerSessions,
        rpc: PeerRpc,
        on_warning: Callable[[str, str, str], None],
        counters: Counters,
        gate: PermissionGate = OPEN_GATE,
    ) -> None:
        self._sessions = sessions
        self._rpc = rpc
        self._on_warning = on_warning
        self._counters = counters
        self._gate = gate
        self._paths: dict[tuple[int, str, str], dict[str, Path]] = {}
        """By peer, name and node; then by user."""
        self._probes: dict[tuple[int, int, str], asyncio.Task[Unmet | None]] = {}
        self._asks: dict[int, asyncio.Semaphore] = {}
        self._tasks: set[asyncio.Task[Any]] = set()
        self._closed = False

    def __iter__(self) -> Iterator[Path]:
        """Every path; changes during the iteration are allowed."""
        return iter([path for users in self._paths.values() for path in users.values()])

    def of(self, peer: int, name: str, node: str) -> list[Path]:
        """The paths to one node's topic or service, by the names of their users."""
        return [path for _, path in sorted(self._paths.get((peer, name, node), {}).items())]

    def get(self, peer: int, want: Want) -> Path | None:
        """One path; ``None`` if it is not known."""
        return self._paths.get((peer, *want[:2]), {}).get(want.user)

    def target(self, path: Path) -> tuple[str, int] | None:
        """Where a new connection should lead; ``None``: to the agents."""
        session = self._sessions.get(path.peer)
        return (session.address, path.found.port) if session is not None and isinstance(path.found, Grant) else None

    @staticmethod
    def _now() -> float:
        return asyncio.get_running_loop().time()

    # --- what subclasses do -----------------------------------------------------------------------------------------

    async def _probe(self, session: PeerSession, path: Path, grant: Grant) -> str:
        """Why a node cannot be reached from here; empty: it can."""
        raise NotImplementedError

    def _decided(self, path: Path) -> None:
        """Carry out a decision."""
        raise NotImplementedError

    def _unmet_now(self, path: Path) -> Unmet | None:  # noqa: ARG002 - for those that override it
        """The condition that does not hold at this moment, if any."""
        return None

    # --- the local graph --------------------------------------------------------------------------------------------

    def judge(
        self, peer: int, want: Want, wanted: Transport, unmet: Unmet | None, contract: Contract | None = None
    ) -> None:
        """Judge a path that is new, or for which something changed here.

        Args:
            peer: The number of the peer's session.
            want: What is reached.
            wanted: The transport that this module's rules ask for.
            unmet: The condition that does not hold here, if any.
            contract: That of the topic here.
        """
        users = self._paths.setdefault((peer, *want[:2]), {})
        path = users.get(want.user)
        if path is None:
            path = users[want.user] = Path(peer, want)
        elif (path.wanted, path.unmet_here, path.contract) == (wanted, unmet, contract):
            return
        path.wanted, path.unmet_here, path.contract = wanted, unmet, contract
        self._start(path)

    def forget(self, path: Path) -> None:
        """Forget a path that is not used any more; its connections stay as they are."""
        users = self._paths.get((path.peer, *path.want[:2]), {})
        users.pop(path.want.user, None)
        if not users:
            self._paths.pop((path.peer, *path.want[:2]), None)
        self._stop(path)
        path.decided.set()
        self._release(path)

    # --- links ------------------------------------------------------------------------------------------------------

    def link_up(self, session: PeerSession) -> None:
        """Ask for all of a peer again; what stands goes on if the answer is the same."""
        for path in self:
            if path.peer == session.peer:
                self._start(path)

    def link_down(self, session: PeerSession, *, crashed: bool) -> None:
        """Relay all of a peer that cannot be reached; if only its agent has died, what stands goes on."""
        for path in self:
            if path.peer == session.peer:
                self._stop(path)
                if crashed and path.endpoint is not None:
                    path.decided.set()
                else:
                    self._decide(path, path.unmet_here or NO_LINK)

    def gone(self, session: PeerSession) -> None:
        """Forget a peer."""
        self._asks.pop(session.peer, None)
        for path in self:
            if path.peer == session.peer:
                self.forget(path)

    async def close(self) -> None:
        """Stop everything; direct connections go on."""
        self._closed = True
        for path in self:
            self._stop(path)
        tasks = list(self._tasks)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    # --- decisions --------------------------------------------------------------------------------------------------

    async def decision(self, path: Path) -> None:
        """Wait for the decision, at most ``limits.DIRECT_HOLD``."""
        try:
            async with asyncio.timeout(limits.DIRECT_HOLD):
                await path.decided.wait()
        except TimeoutError:
            self._counters.add("direct.undecided")

    def broke(self, path: Path) -> None:
        """Ask again for what was direct until its connection ended by itself, unless that happens all the time."""
        now = self._now()
        path.broken = True
        path.breaks.append(now)
        if len(path.breaks) == limits.DIRECT_BREAKS and now - path.breaks[0] < limits.DIRECT_BREAKS_SPAN:
            self._stop(path)
            self._decide(path, _UNSTABLE)
        else:
            self._start(path)

    def _asked_again(self, session: PeerSession, args: dict[str, Any]) -> None:
        path = self.get(session.peer, read_want(args))
        if path is None or path.unmet_here is not None or path.found is _UNSTABLE:
            return
        pause = path.asked_at + limits.DIRECT_RETRY_PAUSE - self._now()
        if pause <= 0:
            self._start(path)
        else:  # the present question may be outdated: it is not waited for
            self._stop(path)
            path.decided.clear()
            self._retry_in(path, pause)

    def _retry_in(self, path: Path, seconds: float) -> None:
        path.retry = asyncio.get_running_loop().call_later(seconds, self._start, path)

    def _start(self, path: Path) -> None:
        self._stop(path)
        if self._closed:
            return
        session = self._sessions.get(path.peer)
        unmet = path.unmet_here or (None if session is not None and session.linked else NO_LINK)
        if unmet is not None:
            self._decide(path, unmet)
            return
        path.decided.clear()
        path.task = self._spawn(self._find(path), f"direct {path.want.name}")

    def _stop(self, path: Path) -> None:
        if path.task is not None and path.task is not asyncio.current_task():
            path.task.cancel()
        if path.retry is not None:
            path.retry.cancel()
        path.task = path.retry = None

    def _spawn(self, work: Coroutine[Any, Any, Any], name: str) -> asyncio.Task[Any]:
        task = asyncio.create_task(work, name=name)
        self._tasks.add(task)
        task.add_done_callback(self._ended)
        return task

    def _ended(self, task: asyncio.Task[Any]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            self._counters.add("direct.failed")
            _log.error("! %s failed", task.get_name(), exc_info=error)

    async def _find(self, path: Path) -> None:
        found: Grant | Unmet = Unmet(Condition.AGENT, "this agent failed")
        try:
            found = self._unmet_now(path) or await self._ask(path)
            if isinstance(found, Grant):
                found = await self._reached(path, found) or self._unmet_now(path) or found
        finally:  # of this agent's own failures, too
            if path.task is asyncio.current_task():
                path.task = None
                self._decide(path, found)

    def _decide(self, path: Path, found: Grant | Unmet) -> None:
        path.found, path.since = found, self._now()
        path.decided.set()
        if isinstance(found, Unmet):
            self._release(path)
            if not found.lasting:
                self._retry_in(path, limits.DIRECT_RETRY)
            self._warn(path, found)
        self._decided(path)

    def _warn(self, path: Path, unmet: Unmet) -> None:
        if path.wanted is Transport.DIRECT and unmet.condition not in {Condition.TRANSPORT, Condition.MEASURES}:
            subject = self._subject(path)
            text = f'{subject}: relayed although transport is "direct": {unmet.text}'
            self._on_warning("direct.relayed", f"{path.peer} {subject} {unmet.condition}", text)

    def _subject(self, path: Path) -> str:
        """A path in a warning."""
        raise NotImplementedError

    async def _ask(self, path: Path) -> Grant | Unmet:
        session, want = self._sessions.get(path.peer), path.want
        if session is None:
            return NO_LINK
        limit = self._asks.setdefault(path.peer, asyncio.Semaphore(limits.DIRECT_ASKS))
        async with limit:
            args = write(DirectAsk(*want, path.contract if want.user else None, path.broken))
            path.asked_at, path.broken, path.held = self._now(), False, True
            found: Grant | Unmet
            try:
                value = await self._rpc.request(session, f"direct.{self.kind}", args, limits.DIRECT_ASK_TIMEOUT)
                found = read_reply(value, want.node)
                path.held = isinstance(found, Grant)
            except PeerRefused as error:
                older = UNKNOWN_QUESTION in error.reason
                found = Unmet(Condition.RELEASE if older else Condition.AGENT, str(error))
            except RemoteProtocolError as error:
                found = Unmet(Condition.RELEASE, f"{session.link.name}: {error}")
            except RmpaError as error:
                found = Unmet(Condition.AGENT, str(error))
            return found

    async def _reached(self, path: Path, grant: Grant) -> Unmet | None:
        """Probes a node, once for all that ask for it at a time."""
        session = self._sessions.get(path.peer)
        if session is None:
            return NO_LINK
        key = (id(session.link), grant.port, "" if path.want.user else path.want.name)
        task = self._probes.get(key)
        if task is None:
            task = self._probes[key] = self._spawn(self._probed(session, path, grant), f"probe {grant.node}")
            task.add_done_callback(lambda _: self._probes.pop(key, None))
        return await asyncio.shield(task)

    async def _probed(self, session: PeerSession, path: Path, grant: Grant) -> Unmet | None:
        problem = await self._probe(session, path, grant)
        return Unmet(Condition.REACHABLE, problem) if problem else None

    def _release(self, path: Path) -> None:
        """Gives back a grant that the peer may hold."""
        session = self._sessions.get(path.peer)
        if path.held and session is not None and session.linked:
            path.held = False
            self._rpc.notify(session, f"direct.{self.kind}_release", path.want._asdict())


@dataclass(slots=True)
class Interruption:
    """That a subscriber was without its direct path: what was published meanwhile is lost to it, and not counted.

    Args:
        count: How often.
        began: When the last one began, monotonic seconds.
        ended: When it ended; ``None`` while it lasts.
    """

    count: int
    began: float
    ended: float | None = None


class Interruptions:
    """The interruptions of direct paths, by the peer's name and what is reached. They outlast links."""

    def __init__(self) -> None:
        self._all: dict[tuple[str, Want], Interruption] = {}

    def get(self, peer: str, want: Want) -> Interruption | None:
        """The interruptions of one subscriber; ``None``: there was none."""
        return self._all.get((peer, want))

    def begin(self, peer: str, want: Want, now: float) -> None:
        """Note that a path is gone; does nothing while it was gone already."""
        before = self._all.pop((peer, want), None)
        if before is None or before.ended is not None:
            before = Interruption(before.count + 1 if before is not None else 1, now)
        self._all[peer, want] = before
        if len(self._all) > limits.DIRECT_MAX:
            del self._all[next(iter(self._all))]

    def end(self, peer: str, want: Want, now: float) -> None:
        """Note that a subscriber has a path again, direct or relayed."""
        found = self._all.get((peer, want))
        if found is not None and found.ended is None:
            found.ended = now
