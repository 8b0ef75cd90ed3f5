"""Which type of ROS 2 stands for one of ROS 1, and the messages of actions on both sides.

Which type of ROS 2 stands for a type of ROS 1: by name, and by ros1_bridge's mapping files.

A mapping file is a YAML list of rules (ros1_bridge's doc/index.rst): of packages (``ros1_package_name``,
``ros2_package_name``), of messages (also ``ros1_message_name``, ``ros2_message_name``) or services
(``…_service_name``), and of fields (also ``fields_1_to_2``; ``request_fields_1_to_2`` and
``response_fields_1_to_2`` of services). A path of fields has dots: ``header.stamp``.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Final, TypeVar

import yaml

from rmpa.core.errors import ConfigError, RemoteProtocolError
from rmpa.core.identity import is_type_name
from rmpa.gateway import limits
from rmpa.gateway.ros2.transcoder import HEAD

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterable, Mapping
    from pathlib import Path

    from rmpa.ros.wire.tcpros import Buffer

_FIELD_KEYS: Final = ("fields_1_to_2", "request_fields_1_to_2", "response_fields_1_to_2")
_ACTION_KEYS: Final = ("goal_fields_1_to_2", "result_fields_1_to_2", "feedback_fields_1_to_2")
"""ros1_bridge has no actions; these keys are made as its others are."""
_KEYS: Final = frozenset(
    (
        *_FIELD_KEYS,
        *_ACTION_KEYS,
        *(f"ros{version}_{kind}_name" for version in (1, 2) for kind in ("package", "message", "service", "action")),
        "enable_foreign_mappings",
    )
)
_USUAL: Final = {
    "rosgraph_msgs/Log": "rcl_interfaces/msg/Log",
    "tf/tfMessage": "tf2_msgs/msg/TFMessage",
    "rospy_tutorials/AddTwoInts": "example_interfaces/srv/AddTwoInts",
    "roscpp_tutorials/TwoInts": "example_interfaces/srv/AddTwoInts",
    "roscpp/Empty": "std_srvs/srv/Empty",
}
"""Pairs with other names in ROS 2, as the mapping files of ROS 2's own packages have them."""
FieldPaths = dict[str, str]
"""A field of ROS 1 to one of ROS 2, each a path with dots."""
_LOG_FIELDS: Final[FieldPaths] = {
    "header.stamp": "stamp",
    "level": "level",
    "name": "name",
    "msg": "msg",
    "file": "file",
    "function": "function",
    "line": "line",
}


@dataclass(frozen=True, slots=True)
class TypePair:
    """A type of ROS 2 for one of ROS 1.

    Args:
        name: ``package/msg/Name`` or ``package/srv/Name``.
        fields: The fields by path, if a rule lists them: then no other field is converted. ``None``: by name.
        request: Likewise of a service's request.
        response: Likewise of a service's response.
    """

    name: str
    fields: FieldPaths | None = None
    request: FieldPaths | None = None
    response: FieldPaths | None = None


@dataclass(frozen=True, slots=True)
class ActionRule:
    """A type of ROS 2 for an action of ROS 1.

    Args:
        name: ``package/action/Name``.
        goal: The fields of the goal by path, if a rule lists them; ``None``: by name.
        result: Likewise of the result.
        feedback: Likewise of the feedback.
    """

    name: str
    goal: FieldPaths | None = None
    result: FieldPaths | None = None
    feedback: FieldPaths | None = None

    @property
    def has_fields(self) -> bool:
        """Whether it lists fields."""
        return (self.goal, self.result, self.feedback) != (None, None, None)


_USUAL_ACTIONS: Final = {"actionlib_tutorials/Fibonacci": "example_interfaces/action/Fibonacci"}


@dataclass(slots=True)
class TypeMapping:
    """The rules of all mapping files; a later file's rule replaces an earlier one of the same type."""

    _messages: dict[str, TypePair] = field(default_factory=dict)
    _services: dict[str, TypePair] = field(default_factory=dict)
    _packages: dict[str, list[str]] = field(default_factory=dict)
    _actions: dict[str, ActionRule] = field(default_factory=dict)

    def read(self, path: Path) -> None:
        """Take in a mapping file.

        Raises:
            ConfigError: It cannot be read, or a rule is wrong; the error names the rule.
        """
        try:
            rules = yaml.safe_load(path.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
            raise ConfigError("gateway.ros2.mapping", f"cannot be read: {error}", path=path) from error
        if not isinstance(rules, list):
            raise ConfigError("gateway.ros2.mapping", "is not a list of rules", "as ros1_bridge has them", path=path)
        for number, rule in enumerate(rules, 1):
            if problem := self._add(rule):
                raise ConfigError("gateway.ros2.mapping", f"rule {number} {problem}", path=path)

    def message(self, name: str, known: Container[object]) -> TypePair | None:
        """The ROS 2 type of a message type.

        Args:
            name: ``package/Name`` of ROS 1.
            known: The names of ROS 2's types.

        Returns:
            The pair; ``None`` if no rule has one and ROS 2 knows no type of this name.
        """
        if (found := self._messages.get(name)) is not None:
            return found
        if name in _USUAL and _USUAL[name] in known:
            return TypePair(_USUAL[name], _LOG_FIELDS if name == "rosgraph_msgs/Log" else None)
        return next((TypePair(each) for each in self._candidates(name, "msg") if each in known), None)

    def service(self, name: str) -> TypePair:
        """The ROS 2 type of a service type; without a rule the one of the same name."""
        if (found := self._services.get(name)) is not None:
            return found
        return TypePair(_USUAL.get(name) or next(iter(self._candidates(name, "srv"))))

    def action(self, name: str) -> ActionRule:
        """The ROS 2 type of an action type, ``package/Name`` of ROS 1; without a rule the one of the same name."""
        if (found := self._actions.get(name)) is not None:
            return found
        package, _, base = name.partition("/")
        packages = (*self._packages.get(package, ()), package)
        return ActionRule(_USUAL_ACTIONS.get(name) or f"{packages[0]}/action/{base}")

    def ros1_action(self, name: str) -> str:
        """The ROS 1 type of an action type, ``package/action/Name`` of ROS 2; the same name without a rule."""
        package, _, rest = name.partition("/")
        base = rest.partition("/")[2]
        ruled = [ros1 for ros1, rule in self._actions.items() if rule.name == name]
        usual = [ros1 for ros1, ros2 in _USUAL_ACTIONS.items() if ros2 == name]
        packages = [f"{ros1}/{base}" for ros1, all_of in self._packages.items() if package in all_of]
        return next(iter((*ruled, *usual, *packages, f"{package}/{base}")))

    def has_service_rule(self, name: str) -> bool:
        """Whether a mapping file has a rule for a service type of ROS 1 or its package."""
        return name in self._services or name.partition("/")[0] in self._packages

    def ros1_message(self, name: str, known: Iterable[str] = ()) -> str:
        """The ROS 1 type of a message type of ROS 2, ``package/msg/Name``; the same name without a rule.

        Args:
            name: The type of ROS 2.
            known: ROS 1 types that are known here; one of them wins if several stand for the type.
        """
        return self._reverse(name, self._messages, set(known))

    def ros1_service(self, name: str) -> str:
        """The ROS 1 type of a service type of ROS 2, ``package/srv/Name``; the same name without a rule."""
        return self._reverse(name, self._services, set())

    def _reverse(self, name: str, rules: Mapping[str, TypePair], known: set[str]) -> str:
        package, _, rest = name.partition("/")
        base = rest.partition("/")[2]
        ruled = [ros1 for ros1, pair in rules.items() if pair.name == name]
        usual = [ros1 for ros1, ros2 in _USUAL.items() if ros2 == name]
        packages = [ros1 for ros1, all_of in self._packages.items() if package in all_of]
        same = f"{package}/{base}"
        found = [*ruled, *([same] if same in known else []), *usual, *(f"{each}/{base}" for each in packages)]
        return next((each for each in found if each in known), found[0] if found else same)

    def _candidates(self, name: str, kind: str) -> list[str]:
        package, _, base = name.partition("/")
        packages = [*self._packages.get(package, ()), package]
        if package.endswith("_msgs"):
            packages.append(package.removesuffix("_msgs") + "_interfaces")
        return [f"{each}/{kind}/{base}" for each in packages]

    def _add(self, rule: Any) -> str:
        """Take in one rule; return what is wrong with it, or an empty text."""
        if not isinstance(rule, dict):
            return "is not a mapping"
        if unknown := [str(key) for key in rule if key not in _KEYS]:
            return f"has the unknown key {min(unknown)!r}"
        names = {key: each for key, each in rule.items() if key.endswith("_name")}
        if wrong := [key for key, each in names.items() if not isinstance(each, str)]:
            return f"has no text as {wrong[0]}"
        package1, package2 = names.get("ros1_package_name"), names.get("ros2_package_name")
        if package1 is None or package2 is None:
            return "needs ros1_package_name and ros2_package_name"
        for kind, into in (("message", self._messages), ("service", self._services)):
            name1, name2 = names.get(f"ros1_{kind}_name"), names.get(f"ros2_{kind}_name")
            if (name1 is None) != (name2 is None):
                return f"needs both ros1_{kind}_name and ros2_{kind}_name, or none of them"
            if name1 is not None:
                return self._add_type(into, f"{package1}/{name1}", f"{package2}/{kind[:1]}", str(name2), rule)
        name1, name2 = names.get("ros1_action_name"), names.get("ros2_action_name")
        if (name1 is None) != (name2 is None):
            return "needs both ros1_action_name and ros2_action_name, or none of them"
        if name1 is not None:
            return self._add_action(f"{package1}/{name1}", package2, str(name2), rule)
        if any(key in rule for key in (*_FIELD_KEYS, *_ACTION_KEYS)):
            return "maps fields, but names no message, service or action"
        self._packages.setdefault(package1, []).append(package2)
        return ""

    def _add_action(self, ros1: str, package: str, base: str, rule: dict[str, Any]) -> str:
        if not is_type_name(ros1) or not is_type_name(f"{package}/{base}"):
            return f"maps {ros1!r} to {package}/{base}: not a name of a type"
        paths, problem = _paths(rule, _ACTION_KEYS)
        if not problem:
            self._actions[ros1] = ActionRule(f"{package}/action/{base}", *paths)
        return problem

    def _add_type(self, into: dict[str, TypePair], ros1: str, head: str, base: str, rule: dict[str, Any]) -> str:
        package, _, kind = head.partition("/")
        if not is_type_name(ros1) or not is_type_name(f"{package}/{base}"):
            return f"maps {ros1!r} to {package}/{base}: not a name of a type"
        paths, problem = _paths(rule, _FIELD_KEYS)
        if problem:
            return problem
        into[ros1] = TypePair(f"{package}/{'msg' if kind == 'm' else 'srv'}/{base}", *paths)
        return ""


def _paths(rule: dict[str, Any], keys: Iterable[str]) -> tuple[list[FieldPaths | None], str]:
    """The mappings of fields under each of the keys, and what is wrong with one."""
    paths: list[FieldPaths | None] = []
    for key in keys:
        fields = rule.get(key)
        if fields is not None and not (
            isinstance(fields, dict) and all(isinstance(each, str) for pair in fields.items() for each in pair)
        ):
            return [], f"has no mapping of fields to fields as {key}"
        paths.append(fields)
    return paths, ""


# The messages of actions: actionlib's of ROS 1, and those of action_msgs of ROS 2, without the goals' own fields.
#
# ROS 1's ``ActionGoal``, ``ActionResult`` and ``ActionFeedback`` end with the goal's own part, which is taken as
# bytes.
# In ROS 2 a goal's and a feedback's own part stand behind the 16 bytes of the goal's id, which keep the alignment
# of
# CDR, so its bytes are taken too. Sources: actionlib_msgs, action_msgs, unique_identifier_msgs, rosidl_parser.
#
# All readers raise ``RemoteProtocolError`` for bytes that are too short, and for a state that is unknown.


_T = TypeVar("_T")
UUID_BYTES: Final = 16
ALL_GOALS: Final = bytes(UUID_BYTES)
"""The id in a request to cancel that means all goals."""
_U32: Final = struct.Struct("<I")
_TIME: Final = struct.Struct("<II")
_INFO: Final = struct.Struct("<16siI")

Ros1Status = IntEnum(
    "Ros1Status",
    "PENDING ACTIVE PREEMPTED SUCCEEDED ABORTED REJECTED PREEMPTING RECALLING RECALLED LOST",
    start=0,
)
"""The states of actionlib_msgs/GoalStatus."""
Ros2Status = IntEnum("Ros2Status", "UNKNOWN ACCEPTED EXECUTING CANCELING SUCCEEDED CANCELED ABORTED", start=0)
"""The states of action_msgs/GoalStatus."""
CancelCode = IntEnum("CancelCode", "NONE REJECTED UNKNOWN_GOAL GOAL_ENDED", start=0)
"""The answers of action_msgs/CancelGoal."""
UNDER_WAY: Final = (Ros1Status.PENDING, Ros1Status.ACTIVE, Ros1Status.PREEMPTING, Ros1Status.RECALLING)
"""The states that another one follows."""
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
"""Each state of ROS 1; the first of those with one counterpart stands for it in ROS 1."""
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
