"""The goals of actions between ROS 1 and ROS 2: their messages, and what becomes of a goal in each direction.

ROS 1's ``ActionGoal``, ``ActionResult`` and ``ActionFeedback`` end with the goal's own part, which is taken as bytes.
In ROS 2 a goal's and a feedback's own part stand behind the 16 bytes of the goal's id, which keep the alignment of
CDR, so its bytes are taken too. Sources: actionlib_msgs, action_msgs, unique_identifier_msgs, rosidl_parser. What
takes a message raises ``RemoteProtocolError`` for bytes that are too short and for a state that is unknown, and
``ConversionError`` for what does not fit the other side's type.
"""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeVar
from uuid import UUID

from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway import limits
from rmpa.gateway.ros2.conversion import ConversionError
from rmpa.gateway.ros2.transcoder import HEAD

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rmpa.gateway.ros2.graph import Query
    from rmpa.gateway.ros2.pairs import ActionPair
    from rmpa.ros.wire.tcpros import Buffer
    from rmpa.runtime.loop import SystemClock

# Seconds between two messages of an action's status in ROS 1; actionlib's ``status_frequency`` is 5 Hz, and its
# clients count a server as lost after 5 s without one.
_ROS2_STATUS_PERIOD: Final = 0.2
_T = TypeVar("_T")
UUID_BYTES: Final = 16
# The id in a request to cancel that means all goals.
ALL_GOALS: Final = bytes(UUID_BYTES)
_U32: Final = struct.Struct("<I")
_TIME: Final = struct.Struct("<II")
_INFO: Final = struct.Struct("<16siI")

# The states of actionlib_msgs/GoalStatus.
Ros1Status = IntEnum(
    "Ros1Status",
    "PENDING ACTIVE PREEMPTED SUCCEEDED ABORTED REJECTED PREEMPTING RECALLING RECALLED LOST",
    start=0,
)
# The states of action_msgs/GoalStatus.
Ros2Status = IntEnum("Ros2Status", "UNKNOWN ACCEPTED EXECUTING CANCELING SUCCEEDED CANCELED ABORTED", start=0)
# The answers of action_msgs/CancelGoal.
CancelCode = IntEnum("CancelCode", "NONE REJECTED UNKNOWN_GOAL GOAL_ENDED", start=0)
# The states that another one follows.
UNDER_WAY: Final = (Ros1Status.PENDING, Ros1Status.ACTIVE, Ros1Status.PREEMPTING, Ros1Status.RECALLING)
# Each state of ROS 1; the first of those with one counterpart stands for it in ROS 1.
TO_ROS2: Final = {
    Ros1Status[ros1]: Ros2Status[ros2]
    for ros2, many in (
        ("ACCEPTED", "PENDING"),
        ("EXECUTING", "ACTIVE"),
        ("CANCELING", "PREEMPTING RECALLING"),
        ("SUCCEEDED", "SUCCEEDED"),
        ("CANCELED", "PREEMPTED RECALLED"),
        ("ABORTED", "ABORTED REJECTED LOST"),
    )
    for ros1 in many.split()
}
TO_ROS1: Final = {ros2: ros1 for ros1, ros2 in reversed(TO_ROS2.items())} | {Ros2Status.UNKNOWN: Ros1Status.LOST}


@dataclass(frozen=True, slots=True)
class GoalId:
    """actionlib_msgs/GoalID: the goal's id, and its stamp in seconds and nanoseconds."""

    id: str = ""
    stamp: tuple[int, int] = (0, 0)

    def serialize(self) -> bytes:
        """The bytes of a GoalID of ROS 1."""
        return _TIME.pack(*self.stamp) + _text(self.id)


@dataclass(frozen=True, slots=True)
class GoalState:
    """actionlib_msgs/GoalStatus: a goal and its state."""

    goal: GoalId
    status: Ros1Status
    text: str = ""

    def serialize(self) -> bytes:
        """The bytes of a GoalStatus of ROS 1."""
        return b"".join((self.goal.serialize(), bytes((self.status,)), _text(self.text)))


class _Reader:
    """Reads a serialized message of ROS 1."""

    def __init__(self, raw: Buffer) -> None:
        self.raw = memoryview(raw)
        self.at = 0

    def number(self) -> int:
        self.at += _U32.size
        return int(_U32.unpack_from(self.raw, self.at - _U32.size)[0])

    def text(self) -> str:
        size = self.number()
        if size > len(self.raw) - self.at:
            raise ValueError("a string is longer than its message")
        self.at += size
        return bytes(self.raw[self.at - size : self.at]).decode("utf-8", "replace")

    def goals(self) -> int:
        if (count := self.number()) > limits.ROS2_GOALS_MAX:
            raise ValueError(f"{count} goals")
        return count

    def behind_header(self) -> _Reader:
        self.at += 12
        self.text()
        return self

    def goal(self) -> GoalId:
        stamp = self.number(), self.number()
        return GoalId(self.text(), stamp)

    def state(self) -> GoalState:
        goal = self.goal()
        self.at += 1
        return GoalState(goal, Ros1Status(self.raw[self.at - 1]), self.text())

    def states(self) -> list[GoalState]:
        return [self.state() for _ in range(self.goals())]

    def rest(self) -> bytes:
        return bytes(self.raw[self.at :])


def _read(raw: Buffer, what: str, read: Callable[[_Reader], _T]) -> _T:
    try:
        return read(_Reader(raw))
    except (struct.error, ValueError, IndexError) as error:
        raise RemoteProtocolError(f"{len(raw)} bytes are no {what}: {error}") from error


def parse_goal(raw: Buffer) -> tuple[GoalId, bytes]:
    """Read an ``ActionGoal``: its id, and the bytes of the goal."""
    return _read(raw, "goal of an action", lambda reader: (reader.behind_header().goal(), reader.rest()))


def parse_cancel(raw: Buffer) -> GoalId:
    """Read a ``GoalID`` of the topic *cancel*."""
    return _read(raw, "GoalID", _Reader.goal)


def parse_outcome(raw: Buffer) -> tuple[GoalState, bytes]:
    """Read an ``ActionResult`` or ``ActionFeedback``: the goal's state, and the bytes of result or feedback."""
    what = "result or feedback of an action"
    return _read(raw, what, lambda reader: (reader.behind_header().state(), reader.rest()))


def parse_states(raw: Buffer) -> list[GoalState]:
    """Read a ``GoalStatusArray`` of ROS 1."""
    return _read(raw, "GoalStatusArray", lambda reader: reader.behind_header().states())


def ros1_message(stamp: int, *parts: bytes) -> bytes:
    """A message of ROS 1: a header with a stamp in nanoseconds since 1970, and the serialized rest."""
    return b"".join((bytes(4), _TIME.pack(*divmod(stamp, 10**9)), bytes(4), *parts))


def ros1_states(stamp: int, states: Iterable[GoalState]) -> bytes:
    """A ``GoalStatusArray`` of ROS 1."""
    made = [state.serialize() for state in states]
    return ros1_message(stamp, _U32.pack(len(made)), *made)


def _text(text: str) -> bytes:
    raw = text.encode("utf-8", "replace")
    return _U32.pack(len(raw)) + raw


def with_uuid(uuid: bytes, cdr: bytes) -> bytes:
    """``SendGoal_Request`` or ``FeedbackMessage``: the goal's id before its own part, which is CDR with its head."""
    return b"".join((cdr[:4], uuid, cdr[4:]))


def split_uuid(raw: Buffer) -> tuple[bytes, bytes]:
    """The goal's id, and its own part as CDR with a head; the inverse of :func:`with_uuid`."""
    view = bytes(raw)
    return _unpack("16s", view, "message of an action")[0], view[:4] + view[20:]


def send_goal_response(stamp: int, *, accepted: bool) -> bytes:
    """``SendGoal_Response``; ``stamp`` in nanoseconds since 1970."""
    return HEAD + struct.pack("<?3xiI", accepted, *divmod(stamp, 10**9))


def is_accepted(raw: Buffer) -> bool:
    """Read a ``SendGoal_Response``."""
    return bool(_unpack("?", raw, "SendGoal_Response")[0])


def cancel_request(uuid: bytes) -> bytes:
    """``CancelGoal_Request``."""
    return HEAD + _INFO.pack(uuid, 0, 0)


def parse_cancel_request(raw: Buffer) -> tuple[bytes, tuple[int, int]]:
    """Read a ``CancelGoal_Request``: the goal's id and the stamp."""
    uuid, *stamp = _unpack(_INFO.format, raw, "CancelGoal_Request")
    return uuid, (stamp[0], stamp[1])


def cancel_response(code: int, goals: Iterable[tuple[bytes, GoalId]]) -> bytes:
    """``CancelGoal_Response``: the code, and the goals that are being cancelled."""
    infos = [_INFO.pack(uuid, goal.stamp[0] & 0x7FFFFFFF, goal.stamp[1]) for uuid, goal in goals]
    return b"".join((HEAD, struct.pack("<b3xI", code, len(infos)), *infos))


def cancel_code(raw: Buffer) -> int:
    """Read the code of a ``CancelGoal_Response``."""
    return int(_unpack("b", raw, "CancelGoal_Response")[0])


def ros2_states(states: Iterable[tuple[bytes, GoalId, Ros2Status]]) -> bytes:
    """A ``GoalStatusArray`` of ROS 2: ids, stamps and states."""
    made, listed = bytearray(4), list(states)
    for uuid, goal, status in listed:
        made += uuid
        made += bytes(-len(made) % 4)  # an id may stand anywhere, the stamp's numbers are aligned
        made += _TIME.pack(goal.stamp[0] & 0x7FFFFFFF, goal.stamp[1]) + bytes((status,))
    made[:4] = _U32.pack(len(listed))
    return HEAD + bytes(made)


def parse_ros2_states(raw: Buffer) -> list[tuple[bytes, Ros2Status]]:
    """Read a ``GoalStatusArray`` of ROS 2: ids and states."""
    return _read(memoryview(raw)[4:], "GoalStatusArray of ROS 2", _ros2_states)


def _ros2_states(reader: _Reader) -> list[tuple[bytes, Ros2Status]]:
    found = []
    for _ in range(reader.goals()):
        uuid = bytes(reader.raw[reader.at : reader.at + UUID_BYTES])
        reader.at += UUID_BYTES
        reader.at += -reader.at % 4 + _TIME.size + 1
        found.append((uuid, Ros2Status(reader.raw[reader.at - 1])))
    return found


def _unpack(form: str, raw: Buffer, what: str) -> tuple[Any, ...]:
    """What stands behind the head of CDR."""
    try:
        return struct.unpack_from(form, raw, len(HEAD))
    except struct.error as error:
        raise RemoteProtocolError(f"{len(raw)} bytes are no {what}") from error


@dataclass(slots=True)
class _SentToRos1:
    id: GoalId
    uuid: bytes
    # When the goal is given up, unless the server shows it before; afterwards, when it is forgotten.
    deadline: float
    # The request ``send_goal`` that is not answered yet.
    asked: Query | None
    status: Ros1Status = Ros1Status.PENDING
    waiting: list[Query] = field(default_factory=list)
    result: bytes | None = None
    listed: bool = False

    @property
    def ended(self) -> bool:
        return self.result is not None


class Ros1ServerEffects(Protocol):
    """What goals at a server of ROS 1 cause."""

    def tell_ros1(self, topic: str, message: bytes) -> None:
        """Publish a message for ROS 1."""

    def tell_ros2(self, topic: str, message: bytes) -> None:
        """Publish a message for ROS 2."""

    def answer(self, query: Query, response: bytes) -> None:
        """Answer a request of a client."""


class GoalsToRos1:
    """The goals of clients of ROS 2 at a server of ROS 1, without I/O.

    Args:
        action: Does what a goal causes.
        pair: The action's types.
        clock: The time.
    """

    def __init__(self, action: Ros1ServerEffects, pair: ActionPair, clock: SystemClock) -> None:
        self._action = action
        self._pair = pair
        self._clock = clock
        # By the id in ROS 1, which is the text of the UUID.
        self._goals: dict[str, _SentToRos1] = {}

    def send_goal(self, query: Query) -> None:
        """A client calls ``send_goal``."""
        uuid, cdr = split_uuid(query.payload)
        body, name, stamp = self._pair.goal.to_ros1(cdr), str(UUID(bytes=uuid)), self._clock.wall_ns()
        if name in self._goals or len(self._goals) >= limits.ROS2_GOALS_MAX:
            self._action.answer(query, send_goal_response(stamp, accepted=False))
            return
        goal_id = GoalId(name, divmod(stamp, 10**9))
        self._goals[name] = _SentToRos1(goal_id, uuid, self._clock.now() + limits.ROS2_ACCEPT_TIMEOUT, query)
        self._action.tell_ros1("goal", ros1_message(stamp, goal_id.serialize(), body))

    def get_result(self, query: Query) -> None:
        """A client calls ``get_result``; of a goal that is not known the status is UNKNOWN, as rcl answers."""
        uuid, _ = split_uuid(query.payload)
        goal = self._goals.get(str(UUID(bytes=uuid)))
        if goal is None:
            self._action.answer(query, self._pair.result_to_ros2(Ros2Status.UNKNOWN, self._pair.no_result))
        elif sum(len(each.waiting) for each in self._goals.values()) >= limits.ROS2_GOALS_MAX:
            query.reply_error("too many clients wait for results")
        else:
            goal.waiting.append(query)
            if goal.ended:
                self._give_result(goal)

    def cancel_goal(self, query: Query) -> None:
        """A client calls ``cancel_goal``: one goal, all up to a stamp, or all (action_msgs/CancelGoal)."""
        uuid, until = parse_cancel_request(query.payload)
        every = uuid == ALL_GOALS and until == (0, 0)
        asked = [goal for goal in self._goals.values() if every or goal.uuid == uuid or goal.id.stamp <= until]
        open_goals = [goal for goal in asked if not goal.ended]
        for goal in open_goals:
            # With a stamp ROS 1 would cancel all older goals too.
            self._action.tell_ros1("cancel", GoalId(goal.id.id).serialize())
        code = CancelCode.NONE
        if uuid != ALL_GOALS and not open_goals:
            code = CancelCode.GOAL_ENDED if asked else CancelCode.UNKNOWN_GOAL
        self._action.answer(query, cancel_response(code, [(goal.uuid, goal.id) for goal in open_goals]))

    def status(self, raw: Buffer) -> None:
        """The server publishes its status; a goal that it named before, and names no more, is lost."""
        listed, changed = parse_states(raw), False
        for each in listed:
            changed |= self._take_state(each)
        if changed:
            self._tell_states()
        named = {each.goal.id for each in listed}
        for goal in list(self._goals.values()):
            if goal.id.id in named:
                goal.listed = True
            elif goal.listed and not goal.ended:
                self._end(goal, Ros1Status.LOST, self._pair.no_result)

    def feedback(self, raw: Buffer) -> None:
        """The server publishes feedback."""
        state, body = parse_outcome(raw)
        goal = self._goals.get(state.goal.id)
        if goal is not None and not goal.ended:
            if self._take_state(state):
                self._tell_states()
            self._action.tell_ros2("feedback", with_uuid(goal.uuid, self._pair.feedback.to_ros2(body)))

    def result(self, raw: Buffer) -> None:
        """The server publishes a result."""
        state, body = parse_outcome(raw)
        goal = self._goals.get(state.goal.id)
        if goal is not None and not goal.ended:
            self._end(goal, state.status, body)

    def server_gone(self) -> None:
        """The server is gone: all goals end as aborted."""
        for goal in [goal for goal in self._goals.values() if not goal.ended]:
            self._end(goal, Ros1Status.LOST, self._pair.no_result)

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is to be called; ``None``: not."""
        times = [goal.deadline for goal in self._goals.values() if goal.asked is not None or goal.ended]
        return min(times, default=None)

    def handle_timer(self, now: float) -> None:
        """Give up goals that the server does not show, and forget results that were kept long enough."""
        for name, goal in list(self._goals.items()):
            if goal.deadline > now or (goal.asked is None and not goal.ended):
                continue
            if goal.asked is not None:
                goal.asked.reply_error("the action server of ROS 1 does not show the goal")
                self._action.tell_ros1("cancel", GoalId(name).serialize())
            del self._goals[name]
            for query in goal.waiting:
                query.reply_error("the goal is not known any more")

    def _take_state(self, state: GoalState) -> bool:
        """Take in one goal's state; return whether it has changed."""
        goal = self._goals.get(state.goal.id)
        if goal is None or goal.ended:
            return False
        if state.status is Ros1Status.REJECTED:
            self._end(goal, state.status, self._pair.no_result)
            return True
        self._accept(goal, accepted=True)
        if state.status not in UNDER_WAY or goal.status is state.status:
            return False  # an end is told with its result
        goal.status = state.status
        return True

    def _accept(self, goal: _SentToRos1, *, accepted: bool) -> None:
        query, goal.asked = goal.asked, None
        if query is not None:
            self._action.answer(query, send_goal_response(self._clock.wall_ns(), accepted=accepted))

    def _end(self, goal: _SentToRos1, status: Ros1Status, body: bytes) -> None:
        self._accept(goal, accepted=status is not Ros1Status.REJECTED)
        goal.status, goal.result, goal.deadline = status, body, self._clock.now() + limits.ROS2_RESULT_KEPT
        self._tell_states()
        self._give_result(goal)

    def _give_result(self, goal: _SentToRos1) -> None:
        waiting, goal.waiting = goal.waiting, []
        for query in waiting:
            try:
                self._action.answer(query, self._pair.result_to_ros2(TO_ROS2[goal.status], goal.result or b""))
            except ConversionError as error:
                query.reply_error(str(error))

    def _tell_states(self) -> None:
        states = ((goal.uuid, goal.id, TO_ROS2[goal.status]) for goal in self._goals.values() if goal.asked is None)
        self._action.tell_ros2("status", ros2_states(states))


@dataclass(slots=True)
class _SentToRos2:
    id: GoalId
    uuid: bytes
    status: Ros1Status = Ros1Status.PENDING
    text: str = ""
    cancelled: bool = False
    ended: float | None = None

    @property
    def state(self) -> GoalState:
        return GoalState(self.id, self.status, self.text)


class Ros2ServerEffects(Protocol):
    """What goals at a server of ROS 2 cause."""

    def tell_ros1(self, topic: str, message: bytes) -> None:
        """Publish a message for ROS 1."""

    def ask(self, service: str, uuid: bytes, request: bytes) -> None:
        """Call a service of the server; ``answered`` or ``failed`` follows."""


class GoalsToRos2:
    """The goals of clients of ROS 1 at a server of ROS 2, without I/O; arguments as for ``GoalsToRos1``."""

    def __init__(self, action: Ros2ServerEffects, pair: ActionPair, clock: SystemClock) -> None:
        self._action = action
        self._pair = pair
        self._clock = clock
        self._goals: dict[bytes, _SentToRos2] = {}
        self._next_status: float | None = None

    def goal(self, raw: Buffer) -> None:
        """A client publishes an ``ActionGoal``."""
        asked, body = parse_goal(raw)
        stamp = self._clock.wall_ns()
        # A server makes up an id and a stamp that are missing, as actionlib's do.
        name = asked.id or f"/rmpa-{len(self._goals)}-{stamp}"
        asked = GoalId(name, divmod(stamp, 10**9) if asked.stamp == (0, 0) else asked.stamp)
        uuid = hashlib.sha256(name.encode()).digest()[:UUID_BYTES]
        if uuid in self._goals:
            return
        goal = _SentToRos2(asked, uuid)
        if len(self._goals) >= limits.ROS2_GOALS_MAX:
            self._end(goal, Ros1Status.REJECTED, f"{len(self._goals)} goals are known")
            return
        self._goals[uuid] = goal
        try:
            self._action.ask("send_goal", uuid, with_uuid(uuid, self._pair.goal.to_ros2(body)))
        except ConversionError as error:
            self._end(goal, Ros1Status.REJECTED, str(error))

    def cancel(self, raw: Buffer) -> None:
        """A client publishes a ``GoalID``: one goal, all up to a stamp, or all (wiki.ros.org/actionlib)."""
        asked = parse_cancel(raw)
        for goal in self._goals.values():
            older = asked.stamp != (0, 0) and goal.id.stamp <= asked.stamp
            if goal.ended is None and (goal.id.id == asked.id or older or asked == GoalId()) and not goal.cancelled:
                goal.cancelled = True
                if goal.status is not Ros1Status.PENDING:
                    self._action.ask("cancel_goal", goal.uuid, cancel_request(goal.uuid))

    def answered(self, service: str, uuid: bytes, response: bytes) -> None:
        """The server has answered ``send_goal``, ``get_result`` or ``cancel_goal``; late answers are ignored."""
        goal = self._goals.get(uuid)
        if goal is None or goal.ended is not None:
            return
        if service == "send_goal":
            self._accepted(goal, accepted=is_accepted(response))
        elif service == "get_result":
            self._result(goal, response)
        elif cancel_code(response) == CancelCode.NONE:
            goal.status = Ros1Status.PREEMPTING
            self._tell_states()
        else:
            goal.cancelled = False  # it may be cancelled again

    def failed(self, service: str, uuid: bytes, text: str) -> None:
        """The server did not answer: the goal ends, or may be cancelled again."""
        goal = self._goals.get(uuid)
        if goal is not None and goal.ended is None:
            if service == "cancel_goal":
                goal.cancelled = False
            else:
                self._end(goal, Ros1Status.ABORTED, text)

    def server_gone(self) -> None:
        """The server is gone: all goals end as aborted."""
        for uuid in list(self._goals):
            self.failed("", uuid, "the action server of ROS 2 is gone")

    def feedback(self, raw: Buffer) -> None:
        """The server publishes feedback."""
        uuid, cdr = split_uuid(raw)
        goal = self._goals.get(uuid)
        if goal is not None and goal.ended is None:
            self._tell("feedback", goal, self._pair.feedback.to_ros1(cdr))

    def status(self, raw: Buffer) -> None:
        """The server publishes its status: of goals under way ROS 1 is told that they are being preempted."""
        for uuid, status in parse_ros2_states(raw):
            goal = self._goals.get(uuid)
            if status is Ros2Status.CANCELING and goal is not None and goal.status is Ros1Status.ACTIVE:
                goal.status = Ros1Status.PREEMPTING
                self._tell_states()

    def show_status(self, *, wanted: bool) -> None:
        """Begin or stop to publish the status five times a second."""
        self._next_status = self._clock.now() if wanted else None

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is to be called; ``None``: not."""
        return self._next_status

    def handle_timer(self, now: float) -> None:
        """Publish the status, and forget goals that ended a while ago."""
        kept = limits.ROS2_GOAL_KEPT
        for uuid in [u for u, goal in self._goals.items() if goal.ended is not None and goal.ended + kept <= now]:
            del self._goals[uuid]
        if self._next_status is not None and self._next_status <= now:
            self._next_status = now + _ROS2_STATUS_PERIOD
            self._tell_states()

    def _accepted(self, goal: _SentToRos2, *, accepted: bool) -> None:
        if not accepted:
            self._end(goal, Ros1Status.REJECTED, "the server rejects the goal")
            return
        goal.status = Ros1Status.ACTIVE
        self._tell_states()
        self._action.ask("get_result", goal.uuid, with_uuid(goal.uuid, b"\x00\x01\x00\x00"))
        if goal.cancelled:
            self._action.ask("cancel_goal", goal.uuid, cancel_request(goal.uuid))

    def _result(self, goal: _SentToRos2, response: bytes) -> None:
        try:
            number, body = self._pair.result_to_ros1(response)
            status = TO_ROS1[Ros2Status(number)]
        except (ConversionError, ValueError) as error:
            self._end(goal, Ros1Status.ABORTED, str(error))
            return
        self._end(goal, Ros1Status.LOST if status in UNDER_WAY else status, "", body)

    def _tell_states(self) -> None:
        states = (goal.state for goal in self._goals.values())
        self._action.tell_ros1("status", ros1_states(self._clock.wall_ns(), states))

    def _end(self, goal: _SentToRos2, status: Ros1Status, text: str, body: bytes | None = None) -> None:
        goal.status, goal.text, goal.ended = status, text, self._clock.now()
        self._tell_states()
        self._tell("result", goal, self._pair.no_result if body is None else body)

    def _tell(self, topic: str, goal: _SentToRos2, body: bytes) -> None:
        self._action.tell_ros1(topic, ros1_message(self._clock.wall_ns(), goal.state.serialize(), body))
