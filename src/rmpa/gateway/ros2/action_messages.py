"""The messages of actions: actionlib's of ROS 1, and those of action_msgs of ROS 2, without the goals' own fields.

ROS 1's ``ActionGoal``, ``ActionResult`` and ``ActionFeedback`` end with the goal's own part, which is taken as bytes.
In ROS 2 a goal's and a feedback's own part stand behind the 16 bytes of the goal's id, which keep the alignment of
CDR, so its bytes are taken too. Sources: actionlib_msgs, action_msgs, unique_identifier_msgs, rosidl_parser.

All readers raise ``RemoteProtocolError`` for bytes that are too short, and for a state that is unknown.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Final, TypeVar

from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway import limits
from rmpa.gateway.ros2.transcoder import HEAD

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rmpa.ros.wire.tcpros import Buffer

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
    """actionlib_msgs/GoalID.

    Args:
        id: The goal's id.
        secs: Seconds of its stamp.
        nsecs: Nanoseconds of its stamp.
    """

    id: str = ""
    secs: int = 0
    nsecs: int = 0

    @property
    def stamp(self) -> tuple[int, int]:
        """Its stamp, which goals are compared by."""
        return self.secs, self.nsecs

    def serialize(self) -> bytes:
        """The bytes of a GoalID of ROS 1."""
        return _TIME.pack(self.secs, self.nsecs) + _text(self.id)


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

    def behind_header(self) -> _Reader:
        self.at += 12
        self.text()
        return self

    def goal(self) -> GoalId:
        secs, nsecs = self.number(), self.number()
        return GoalId(self.text(), secs, nsecs)

    def state(self) -> GoalState:
        goal = self.goal()
        self.at += 1
        return GoalState(goal, Ros1Status(self.raw[self.at - 1]), self.text())

    def states(self) -> list[GoalState]:
        return [self.state() for _ in range(_bounded(self.number()))]

    def rest(self) -> bytes:
        return bytes(self.raw[self.at :])


def _read(raw: Buffer, what: str, read: Callable[[_Reader], _T]) -> _T:
    try:
        return read(_Reader(raw))
    except (struct.error, ValueError, IndexError) as error:
        raise RemoteProtocolError(f"{len(raw)} bytes are no {what}: {error}") from error


def _bounded(count: int) -> int:
    if count > limits.ROS2_GOALS_MAX:
        raise ValueError(f"{count} goals")
    return count


# --- ROS 1 --------------------------------------------------------------------------------------------------------


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
    """A message of ROS 1 with a header: the parts behind it.

    Args:
        stamp: Of the header, in nanoseconds since 1970.
        parts: The serialized rest.
    """
    return b"".join((bytes(4), _TIME.pack(*divmod(stamp, 10**9)), bytes(4), *parts))


def ros1_states(stamp: int, states: Iterable[GoalState]) -> bytes:
    """A ``GoalStatusArray`` of ROS 1."""
    made = [state.serialize() for state in states]
    return ros1_message(stamp, _U32.pack(len(made)), *made)


def _text(text: str) -> bytes:
    raw = text.encode("utf-8", "replace")
    return _U32.pack(len(raw)) + raw


# --- ROS 2 --------------------------------------------------------------------------------------------------------


def with_uuid(uuid: bytes, cdr: bytes) -> bytes:
    """``SendGoal_Request`` or ``FeedbackMessage``: the goal's id before its own part.

    Args:
        uuid: The goal's id.
        cdr: The own part as CDR with its head.
    """
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


def cancel_request(uuid: bytes, goal: GoalId = GoalId()) -> bytes:
    """``CancelGoal_Request``."""
    return HEAD + _INFO.pack(uuid, goal.secs, goal.nsecs)


def parse_cancel_request(raw: Buffer) -> tuple[bytes, tuple[int, int]]:
    """Read a ``CancelGoal_Request``: the goal's id and the stamp."""
    uuid, *stamp = _unpack(_INFO.format, raw, "CancelGoal_Request")
    return uuid, (stamp[0], stamp[1])


def cancel_response(code: int, goals: Iterable[tuple[bytes, GoalId]]) -> bytes:
    """``CancelGoal_Response``: the code, and the goals that are being cancelled."""
    infos = [_INFO.pack(uuid, goal.secs & 0x7FFFFFFF, goal.nsecs) for uuid, goal in goals]
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
        made += _TIME.pack(goal.secs & 0x7FFFFFFF, goal.nsecs) + bytes((status,))
    made[:4] = _U32.pack(len(listed))
    return HEAD + bytes(made)


def parse_ros2_states(raw: Buffer) -> list[tuple[bytes, Ros2Status]]:
    """Read a ``GoalStatusArray`` of ROS 2: ids and states."""
    return _read(memoryview(raw)[4:], "GoalStatusArray of ROS 2", _ros2_states)


def _ros2_states(reader: _Reader) -> list[tuple[bytes, Ros2Status]]:
    found = []
    for _ in range(_bounded(reader.number())):
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
