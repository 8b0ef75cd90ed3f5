"""One client of the monitor: its messages and the agent's states in; frames and requests out; no I/O.

The client gets a state, then patches, at most one in ``limits.PATCH_PERIOD`` and only while it acknowledges them: a
slow browser gets fewer. The session keeps no queue, just the last state that it sent, which clients share.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import msgspec

from rmpa.core.counters import TokenBucket
from rmpa.core.errors import LimitExceeded, RemoteProtocolError, RmpaError
from rmpa.core.identity import is_global_name
from rmpa.web import limits
from rmpa.web.monitor.live import WatchState
from rmpa.web.monitor.messages import (
    VERSION,
    Ack,
    AskQuestion,
    Drive,
    Log,
    Look,
    ReleaseJoystick,
    Unwatch,
    Watch,
    difference,
    parse,
)
from rmpa.web.monitor.questions import QUESTIONS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.web.hub.node_link import Rights
    from rmpa.web.hub.topics import ReceivedMessage
    from rmpa.web.monitor.live import Decode
    from rmpa.web.monitor.messages import Tree, Value

RIGHTS = ("view", "control", "drive")
"""What a page may have, as ``hello`` lists it."""
_NO_TOKEN = "this page may not read parameters", "open it with a token: rmpa web --token-file FILE, or --control"
_NO_CONTROL = "this page may only look", "start rmpa web with --control"


@dataclass(frozen=True, slots=True)
class Question:
    """The server finds the answer and gives it to ``MonitorSession.answer`` or ``refuse``."""

    id: int
    what: str
    args: dict[str, Any]  # the edge: each question has its own


@dataclass(frozen=True, slots=True)
class Speed:
    """A geometry_msgs/Twist for ``topic``: m/s and rad/s."""

    topic: str
    linear: float
    angular: float


@dataclass(frozen=True, slots=True)
class Subscribe:
    """The messages of a topic are wanted for the watch ``id``."""

    id: int
    topic: str


@dataclass(frozen=True, slots=True)
class Unsubscribe:
    """The watch ``id`` has ended."""

    id: int


@dataclass(frozen=True, slots=True)
class FollowLog:
    """Whether the server is to pass lines of the log to ``MonitorSession.log``."""

    on: bool


@dataclass(frozen=True, slots=True)
class MonitorClose:
    """The client is to be disconnected, with this close code of RFC 6455 and reason.

    ``refusal`` is counted: ``message``, ``message_size`` or ``message_rate``.
    """

    code: int
    reason: str
    refusal: str


Output: TypeAlias = str | bytes | Subscribe | Unsubscribe | Question | Speed | FollowLog | MonitorClose


class Joystick:
    """The holds of one page's stick, and which of its commands drive the robot.

    A hold is from the touch of the stick until it is let go. TCP keeps over a cut what the page has sent, and
    delivers all of it when the cable is back, long after the stick was let go. So each command says when it was made,
    and what may be older than ``limits.DRIVE_TIMEOUT`` is dropped.

    The two clocks need not agree. Each ``tick`` has the server's clock; the page takes the one that came fastest
    among the last few, and its own clock counts on from it. A command's ``at`` is then the server's clock at its
    making, less the time that this tick took: ``now - at`` is never less than the command's age, and in a steady
    network it is the round trip. A tick that was held up, or a clock that stood still while the page's machine slept,
    makes commands seem older, never newer.
    """

    def __init__(self) -> None:
        self._hold = 0
        self._number = 0
        self._released = 0
        self._until = 0.0
        self._topic = ""
        self._told_late = False

    @property
    def topic(self) -> str:
        """The topic that is driven; empty while the robot is stopped."""
        return self._topic

    @property
    def due(self) -> float | None:
        """When the robot is to be stopped, if no further command comes."""
        return self._until if self._topic else None

    def takes(self, command: Drive, now: float) -> bool:
        """Whether a command is to be obeyed: it is not too old, and of the present hold or a later one."""
        if abs(now - command.at) > limits.DRIVE_TIMEOUT:
            return False
        if command.hold <= self._released or (command.hold, command.n) <= (self._hold, self._number):
            return False
        self._hold, self._number = command.hold, command.n
        self._told_late = False
        return True

    def drive(self, topic: str, now: float) -> bool:
        """A command is obeyed; returns whether it may move the robot.

        The first one after a stop only arms: one command alone, whatever kept it, moves nothing.
        """
        armed, self._topic = self._topic == topic, topic
        self._until = now + limits.DRIVE_TIMEOUT
        return armed

    def is_new_late(self, command: Drive, now: float) -> bool:
        """Whether a refused command is the first since the last obeyed one that came too late."""
        told, self._told_late = self._told_late, self._told_late or now - command.at > limits.DRIVE_TIMEOUT
        return self._told_late and not told

    def release(self, hold: int) -> None:
        """The stick was let go: nothing more of that hold is obeyed."""
        self._released = max(self._released, hold)

    def stop(self) -> str:
        """The robot stops; returns the topic that was driven, or nothing."""
        topic, self._topic = self._topic, ""
        return topic


class MonitorSession:
    """One client.

    Args:
        details: Gives all that is known of one thing, by kind and name (``view.details``).
        decode: Gives a message's values.
        rights: What the client may do.
        now: Seconds of the clock of all further calls.
        unsent: Bytes that the client's connection has not taken; above zero no live frame is sent.
    """

    def __init__(
        self,
        details: Callable[[str, str], Tree | None],
        decode: Decode,
        rights: Rights,
        now: float,
        unsent: Callable[[], int] = lambda: 0,
    ) -> None:
        self._details = details
        self._decode = decode
        self._rights = rights
        self._unsent = unsent
        self._bucket = TokenBucket(limits.REQUEST_RATE, limits.REQUEST_BURST)
        self._state: Tree | None = None
        self._shown: Tree | None = None
        self._looks: tuple[tuple[str, str], ...] = ()
        self._number = self._acknowledged = 0
        self._patched = now - limits.PATCH_PERIOD
        self._stale = False
        self._looked = now
        self._tick = now + limits.TICK_PERIOD
        self._watches: dict[int, WatchState] = {}
        self._questions: set[int] = set()
        self._joystick = Joystick()
        self._opened = now

    # --- the client ---

    def open(self, agent: str) -> Iterator[Output]:
        """The first message, before any state; ``agent`` is the name of the agent's module."""
        fastest = {"linear": limits.DRIVE_SPEED, "angular": limits.DRIVE_TURN}
        about = {"version": VERSION, "agent": agent, "period": limits.PATCH_PERIOD, "fastest": fastest}
        about["at"] = self._opened
        yield _text({"op": "hello", **about, "may": [right for right in RIGHTS if getattr(self._rights, right)]})

    def receive(self, text: str | bytes, now: float) -> Iterator[Output]:
        """A message of the client."""
        if not self._bucket.take(now):
            yield MonitorClose(1008, f"more than {limits.REQUEST_RATE:g} messages a second", "message_rate")
            return
        try:
            message = parse(text)
        except RmpaError as error:
            refusal = "message_size" if isinstance(error, LimitExceeded) else "message"
            yield MonitorClose(1008, ascii(str(error))[1:-1][:100], refusal)
            return
        try:
            yield from self._act(message, now)
        except RmpaError as error:
            yield self._failed(getattr(message, "id", 0), str(error))

    def _act(self, message: object, now: float) -> Iterator[Output]:
        if isinstance(message, Ack):
            self._acknowledged = max(self._acknowledged, min(message.n, self._number))
        elif isinstance(message, Look):
            self._looks, self._stale = message.at, True
        elif isinstance(message, Watch):
            yield from self._watch(message)
        elif isinstance(message, Unwatch):
            if self._watches.pop(message.id, None):
                yield Unsubscribe(message.id)
        elif isinstance(message, AskQuestion):
            yield from self._ask(message, now)
        elif isinstance(message, Log):
            yield FollowLog(message.on)
        elif isinstance(message, Drive):
            yield from self._drive(message, now)
        elif isinstance(message, ReleaseJoystick):
            self._joystick.release(message.hold)
            yield from self._stop()
        yield from self.handle_timer(now)

    def _watch(self, message: Watch) -> Iterator[Output]:
        _check_topic(message.topic)
        if message.id in self._watches:
            raise RemoteProtocolError(f"watch {message.id} is in use")
        if len(self._watches) >= limits.WATCHES_MAX:
            raise RemoteProtocolError(f"{limits.WATCHES_MAX} topics are watched already; close one first")
        self._watches[message.id] = WatchState(message, self._decode)
        yield Subscribe(message.id, message.topic)

    def _ask(self, message: AskQuestion, now: float) -> Iterator[Output]:
        if message.what not in QUESTIONS:
            raise RemoteProtocolError(f"there is no question {message.what[:40]!a}")
        needed = QUESTIONS[message.what][0]
        if needed and not getattr(self._rights, needed):
            yield self._failed(message.id, *(_NO_TOKEN if needed == "view" else _NO_CONTROL))
        elif needed == "control" and now - message.at > limits.ORDER_AGE:
            # One that TCP kept over a cut must not act long after the page has given it up.
            late = min(now - message.at, now - self._opened)
            text = f"the order may have come {late:.0f} s late, and is not carried out"
            yield self._failed(message.id, text, "look at what is, and repeat it")
        elif message.id in self._questions or len(self._questions) >= limits.ASKS_MAX:
            yield self._failed(message.id, f"{len(self._questions)} questions wait for an answer already")
        else:
            self._questions.add(message.id)
            yield Question(message.id, message.what, message.args)

    def _drive(self, message: Drive, now: float) -> Iterator[Output]:
        if not self._rights.drive:
            yield self._failed(0, "this page may not drive", "start rmpa web with --drive")
            return
        _check_topic(message.topic)
        joystick = self._joystick
        if not joystick.takes(message, now):
            if joystick.is_new_late(message, now):
                late = f"commands reach the server {now - message.at:.1f} s late, and are dropped"
                yield self._failed(0, late, f"above {limits.DRIVE_TIMEOUT:g} s the robot stays where it is")
            return
        if joystick.topic != message.topic:
            yield from self._stop()
        if joystick.drive(message.topic, now):
            yield Speed(message.topic, message.linear * limits.DRIVE_SPEED, message.angular * limits.DRIVE_TURN)
        else:
            yield Speed(message.topic, 0.0, 0.0)

    def _stop(self) -> Iterator[Output]:
        topic = self._joystick.stop()
        if topic:
            yield Speed(topic, 0.0, 0.0)

    def close(self) -> Iterator[Output]:
        """The connection has ended: the robot is stopped, and what was open is closed."""
        yield from self._stop()
        yield from map(Unsubscribe, self._watches)
        self._watches.clear()
        self._questions.clear()

    # --- the server ---

    def update(self, state: Tree, now: float) -> Iterator[Output]:
        """The newest state, which is never changed after that."""
        self._state, self._stale = state, True
        yield from self.handle_timer(now)

    def receive_message(self, handle: int, message: ReceivedMessage, now: float) -> Iterator[Output]:
        """A message for one of the watches."""
        watch = self._watches.get(handle)
        if watch is None:
            return
        try:
            watch.receive(message)
        except RmpaError as error:
            yield from self.end_watch(handle, str(error))
            yield Unsubscribe(handle)
        yield from self._flush(now)

    def end_watch(self, handle: int, error: str, remedy: str = "") -> Iterator[Output]:
        """The hub cannot subscribe, or the subscription has ended."""
        if self._watches.pop(handle, None):
            yield self._failed(handle, error, remedy)

    def answer(self, question: int, value: Value | Any) -> Iterator[Output]:
        """The answer to a question."""
        if question in self._questions:
            self._questions.discard(question)
            yield _text({"op": "answer", "id": question, "value": value})

    def refuse(self, question: int, error: str, remedy: str = "") -> Iterator[Output]:
        """A question has no answer."""
        if question in self._questions:
            self._questions.discard(question)
            yield self._failed(question, error, remedy)

    def failed(self, error: str, remedy: str = "") -> Iterator[Output]:
        """What the page ordered cannot be done, and is neither a watch nor a question: driving."""
        yield self._failed(0, error, remedy)

    def log(self, lines: list[dict[str, Any]], *, kept: bool = False) -> Iterator[Output]:
        """Lines of the log, oldest first; new ones are left out while the client does not take what was sent."""
        if kept or self._unsent() == 0:
            yield _text({"op": "log", "lines": lines[-limits.LOG_LINES :]})

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is to be called; ``None`` for not before something else happens."""
        dues: list[float | None] = [self._tick, self._joystick.due]
        if self._unsent() == 0:
            dues += [watch.due(0.0) for watch in self._watches.values()]
        elif self._watches:
            dues.append(self._looked + limits.UNSENT_RETRY)
        if self._stale and self._state is not None and self._number - self._acknowledged < limits.UNACKNOWLEDGED_MAX:
            dues.append(self._patched + limits.PATCH_PERIOD)
        return min((due for due in dues if due is not None), default=None)

    def handle_timer(self, now: float) -> Iterator[Output]:
        """Send what is due, and stop a robot that no client commands any more."""
        self._looked = now
        if self._joystick.due is not None and now >= self._joystick.due:
            yield from self._stop()
        if (
            self._stale
            and now >= self._patched + limits.PATCH_PERIOD
            and self._number - self._acknowledged < limits.UNACKNOWLEDGED_MAX
        ):
            yield from self._send_state(now)
        yield from self._flush(now)
        if now >= self._tick:
            self._tick = now + limits.TICK_PERIOD
            if self._unsent() == 0:
                # Scripts do not see WebSocket's pings: a page that misses some ticks takes the connection for lost.
                yield _text({"op": "tick", "at": now})

    def _send_state(self, now: float) -> Iterator[Output]:
        if self._state is None:
            return
        self._stale, self._patched = False, now
        found = {f"{kind}:{name}": self._details(kind, name) for kind, name in self._looks}
        wanted: Tree = {**self._state, "detail": {key: tree for key, tree in found.items() if tree is not None}}
        shown, self._shown = self._shown, wanted
        if shown is None:
            self._number += 1
            yield _text({"op": "state", "n": self._number, "state": wanted})
        elif patch := difference(shown, wanted):
            self._number += 1
            yield _text({"op": "patch", "n": self._number, "patch": patch})

    def _flush(self, now: float) -> Iterator[Output]:
        if self._unsent() > 0:
            return
        for handle, watch in list(self._watches.items()):
            due = watch.due(now)
            if due is None or due > now:
                continue
            try:
                yield from watch.frames(now)
            except RmpaError as error:
                yield from self.end_watch(handle, str(error))
                yield Unsubscribe(handle)

    def _failed(self, id_: int, error: str, remedy: str = "") -> str:
        return _text({"op": "failed", "id": id_, "error": error, "remedy": remedy})


def _check_topic(topic: str) -> None:
    """A user may have typed it, and a master accepts names that are none: it is no fault of the page.

    Raises:
        RemoteProtocolError: It is not a topic's name.
    """
    if not is_global_name(topic):
        raise RemoteProtocolError(f"{topic[:80]!a} is not a topic's name; write it as /name")


def _text(message: dict[str, Any]) -> str:
    return msgspec.json.encode(message).decode()
