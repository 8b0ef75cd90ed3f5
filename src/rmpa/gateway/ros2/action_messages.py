"""The messages of actions: actionlib's of ROS 1, and those of action_msgs of ROS 2, without the goals' own fields.

ROS 1's ``ActionGoal``, ``ActionResult`` and ``ActionFeedback`` end with the goal's own part, which is taken as bytes.
In ROS 2 a goal's and a feedback's own part stand behind the 16 bytes of the goal's id, which keep the alignment of
CDR, so its bytes are taken too. Sources: actionlib_msgs, action_msgs, unique_identifier_msgs, rosidl_parser.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway import limits
from rmpa.gateway.ros2.transcoder import HEAD

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rmpa.ros.wire.tcpros import Buffer

UUID_BYTES: Final = 16
ALL_GOALS: Final = bytes(UUID_BYTES)
"""The id in a request to cancel that means all goals."""
_U32: Final = struct.Struct("<I")
_TIME: Final = struct.Struct("<II")
_INFO: Final = struct.Struct("<16siI")


class Ros1Status(IntEnum):
    """The states of actionlib_msgs/GoalStatus."""

    PENDING = 0
    ACTIVE = 1
    PREEMPTED = 2
    SUCCEEDED = 3
    ABORTED = 4
    REJECTED = 5
    PREEMPTING = 6
    RECALLING = 7
    RECALLED = 8
    LOST = 9

    @property
    def ended(self) -> bool:
        """Whether a goal has no other state after it."""
        return self in _ENDED


_ENDED: Final = frozenset(
    (
        Ros1Status.PREEMPTED,
        Ros1Status.SUCCEEDED,
        Ros1Status.ABORTED,
        Ros1Status.REJECTED,
        Ros1Status.RECALLED,
        Ros1Status.LOST,
    )
)


class Ros2Status(IntEnum):
    """The states of action_msgs/GoalStatus."""

    UNKNOWN = 0
    ACCEPTED = 1
    EXECUTING = 2
    CANCELING = 3
    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6


class CancelCode(IntEnum):
    """The answers of action_msgs/CancelGoal."""

    NONE = 0
    REJECTED = 1
    UNKNOWN_GOAL = 2
    GOAL_ENDED = 3


TO_ROS2: Final = {
    Ros1Status.PENDING: Ros2Status.ACCEPTED,
    Ros1Status.ACTIVE: Ros2Status.EXECUTING,
    Ros1Status.PREEMPTED: Ros2Status.CANCELED,
    Ros1Status.SUCCEEDED: Ros2Status.SUCCEEDED,
    Ros1Status.ABORTED: Ros2Status.ABORTED,
    Ros1Status.REJECTED: Ros2Status.ABORTED,
    Ros1Status.PREEMPTING: Ros2Status.CANCELING,
    Ros1Status.RECALLING: Ros2Status.CANCELING,
    Ros1Status.RECALLED: Ros2Status.CANCELED,
    Ros1Status.LOST: Ros2Status.ABORTED,
}
TO_ROS1: Final = {
    Ros2Status.UNKNOWN: Ros1Status.LOST,
    Ros2Status.ACCEPTED: Ros1Status.PENDING,
    Ros2Status.EXECUTING: Ros1Status.ACTIVE,
    Ros2Status.CANCELING: Ros1Status.PREEMPTING,
    Ros2Status.SUCCEEDED: Ros1Status.SUCCEEDED,
    Ros2Status.CANCELED: Ros1Status.PREEMPTED,
    Ros2Status.ABORTED: Ros1Status.ABORTED,
}


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
        value: int = _U32.unpack_from(self.raw, self.at)[0]
        self.at += _U32.size
        return value

    def byte(self) -> int:
        self.at += 1
        return self.raw[self.at - 1]

    def text(self) -> str:
        size = self.number()
        if size > len(self.raw) - self.at:
            raise ValueError("a string is longer than its message")
        self.at += size
        return bytes(self.raw[self.at - size : self.at]).decode("utf-8", "replace")

    def header(self) -> None:
        self.at += 12
        self.text()

    def goal(self) -> GoalId:
        secs, nsecs = self.number(), self.number()
        return GoalId(self.text(), secs, nsecs)

    def state(self) -> GoalState:
        goal = self.goal()
        return GoalState(goal, Ros1Status(self.byte()), self.text())

    def rest(self) -> bytes:
        return bytes(self.raw[self.at :])


_ERRORS: Final = (struct.error, ValueError, IndexError)


# --- ROS 1 --------------------------------------------------------------------------------------------------------


def parse_goal(raw: Buffer) -> tuple[GoalId, bytes]:
    """Read an ``ActionGoal``: its id, and the bytes of the goal.

    Raises:
        RemoteProtocolError: The bytes are too short.
    """
    try:
        reader = _Reader(raw)
        reader.header()
        return reader.goal(), reader.rest()
    except _ERRORS as error:
        raise RemoteProtocolError(f"{len(raw)} bytes are no goal of an action: {error}") from error


def parse_cancel(raw: Buffer) -> GoalId:
    """Read a ``GoalID`` of the topic *cancel*.

    Raises:
        RemoteProtocolError: The bytes are too short.
    """
    try:
        return _Reader(raw).goal()
    except _ERRORS as error:
        raise RemoteProtocolError(f"{len(raw)} bytes are no GoalID: {error}") from error


def parse_outcome(raw: Buffer) -> tuple[GoalState, bytes]:
    """Read an ``ActionResult`` or ``ActionFeedback``: the goal's state, and the bytes of result or feedback.

    Raises:
        RemoteProtocolError: The bytes are too short, or the state is unknown.
    """
    try:
        reader = _Reader(raw)
        reader.header()
        return reader.state(), reader.rest()
    except _ERRORS as error:
        raise RemoteProtocolError(f"{len(raw)} bytes are no result or feedback of an action: {error}") from error


def parse_states(raw: Buffer) -> list[GoalState]:
    """Read a ``GoalStatusArray`` of ROS 1.

    Raises:
        RemoteProtocolError: The bytes are too short, or a state is unknown.
    """
    try:
        reader = _Reader(raw)
        reader.header()
        count = reader.number()
        if count > limits.ROS2_GOALS_MAX:
            raise ValueError(f"{count} goals")
        return [reader.state() for _ in range(count)]
    except _ERRORS as error:
        raise RemoteProtocolError(f"{len(raw)} bytes are no GoalStatusArray: {error}") from error


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
    """The goal's id, and its own part as CDR with a head; the inverse of :func:`with_uuid`.

    Raises:
        RemoteProtocolError: The bytes are too short.
    """
    if len(raw) < len(HEAD) + UUID_BYTES:
        raise RemoteProtocolError(f"a message of an action has {len(raw)} bytes; an id of a goal alone has 20")
    view = bytes(raw)
    return view[4:20], view[:4] + view[20:]


def send_goal_response(stamp: int, *, accepted: bool) -> bytes:
    """``SendGoal_Response``; ``stamp`` in nanoseconds since 1970."""
    return HEAD + struct.pack("<?3xiI", accepted, *divmod(stamp, 10**9))


def is_accepted(raw: Buffer) -> bool:
    """Read a ``SendGoal_Response``.

    Raises:
        RemoteProtocolError: The bytes are too short.
    """
    if len(raw) < len(HEAD) + 1:
        raise RemoteProtocolError(f"{len(raw)} bytes are no SendGoal_Response")
    return bool(raw[4])


def cancel_request(uuid: bytes, goal: GoalId = GoalId()) -> bytes:
    """``CancelGoal_Request``."""
    return HEAD + _INFO.pack(uuid, goal.secs, goal.nsecs)


def parse_cancel_request(raw: Buffer) -> tuple[bytes, tuple[int, int]]:
    """Read a ``CancelGoal_Request``: the goal's id and the stamp.

    Raises:
        RemoteProtocolError: The bytes are too short.
    """
    try:
        uuid, secs, nsecs = _INFO.unpack_from(raw, 4)
    except struct.error as error:
        raise RemoteProtocolError(f"{len(raw)} bytes are no CancelGoal_Request") from error
    return uuid, (secs, nsecs)


def cancel_response(code: CancelCode, goals: Iterable[tuple[bytes, GoalId]]) -> bytes:
    """``CancelGoal_Response``: the code, and the goals that are being cancelled."""
    infos = [_INFO.pack(uuid, goal.secs & 0x7FFFFFFF, goal.nsecs) for uuid, goal in goals]
    return b"".join((HEAD, struct.pack("<b3xI", code, len(infos)), *infos))


def cancel_code(raw: Buffer) -> int:
    """Read the code of a ``CancelGoal_Response``.

    Raises:
        RemoteProtocolError: The bytes are too short.
    """
    if len(raw) < len(HEAD) + 1:
        raise RemoteProtocolError(f"{len(raw)} bytes are no CancelGoal_Response")
    return int.from_bytes(bytes(raw[4:5]), "little", signed=True)


def ros2_states(states: Iterable[tuple[bytes, GoalId, Ros2Status]]) -> bytes:
    """A ``GoalStatusArray`` of ROS 2: ids, stamps and states."""
    made = bytearray(4)
    count = 0
    for uuid, goal, status in states:
        made += uuid
        made += bytes(-len(made) % 4)  # an id may stand anywhere, the stamp's numbers are aligned
        made += _TIME.pack(goal.secs & 0x7FFFFFFF, goal.nsecs) + bytes((status,))
        count += 1
    made[:4] = _U32.pack(count)
    return HEAD + bytes(made)


def parse_ros2_states(raw: Buffer) -> list[tuple[bytes, Ros2Status]]:
    """Read a ``GoalStatusArray`` of ROS 2: ids and states.

    Raises:
        RemoteProtocolError: The bytes are too short, or a state is unknown.
    """
    body, found = bytes(raw)[4:], []
    try:
        count, at = _U32.unpack_from(body, 0)[0], 4
        if count > limits.ROS2_GOALS_MAX:
            raise ValueError(f"{count} goals")
        for _ in range(count):
            uuid = body[at : at + UUID_BYTES]
            at += UUID_BYTES
            at += -at % 4 + _TIME.size
            found.append((uuid, Ros2Status(body[at])))
            at += 1
    except _ERRORS as error:
        raise RemoteProtocolError(f"{len(raw)} bytes are no GoalStatusArray of ROS 2: {error}") from error
    return found
