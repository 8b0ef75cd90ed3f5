"""Finds the pair of each type, by name or by ros1_bridge's mapping files, with the conversions of its parts.

A pair is found by name and rule; the fields are those of ROS 2's distribution, of a definition that a ROS 1 publisher
sent, or of a description that a ROS 2 node gave.

A mapping file is a YAML list of rules (ros1_bridge's doc/index.rst): of packages (``ros1_package_name``,
``ros2_package_name``), of messages (also ``ros1_message_name``, ``ros2_message_name``) or services
(``…_service_name``), and of fields (also ``fields_1_to_2``; ``request_fields_1_to_2`` and
``response_fields_1_to_2`` of services). A path of fields has dots: ``header.stamp``. ros1_bridge has no actions;
their keys are made as its others are.
"""

from __future__ import annotations

import asyncio
import os
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import yaml
from rosbags.interfaces import Nodetype
from rosbags.typesys.base import TypesysError

from rmpa.config.toml_file import check_writers
from rmpa.core.errors import ConfigError, RemoteProtocolError, RmpaError
from rmpa.core.identity import is_type_name
from rmpa.gateway import limits
from rmpa.gateway.ros2.conversion import Conversion, NoConversion
from rmpa.gateway.ros2.types import EMPTY_MEMBER, TIMES, FieldPaths, TypePair, check_size, ros2_fields, ros2_name
from rmpa.ros.types.definitions import SEPARATOR, DefinitionError, Specification, known_text, known_types
from rmpa.ros.types.find import find_message_type, find_service_type
from rmpa.ros.types.installed import ServiceType
from rmpa.ros.types.messages import MessageType

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterable, Mapping, Sequence
    from pathlib import Path

    from rosbags.typesys.store import Typestore

    from rmpa.gateway.ros2.types import Ros2Types

    _Kept = dict[tuple[str, str], Conversion | NoConversion]

# What a rule may be of, and how ROS 2 has it in the names of types.
_KINDS: Final = {"message": "msg", "service": "srv", "action": "action"}
_PARTS: Final = {"message": ("",), "service": ("request", "response"), "action": ("goal", "result", "feedback")}
# The keys that map fields, and what of the type has them.
_FIELD_KEYS: Final = {f"{part}_fields_1_to_2".lstrip("_"): part for parts in _PARTS.values() for part in parts}
_KEYS: Final = {
    *_FIELD_KEYS,
    *(f"ros{version}_{kind}_name" for version in (1, 2) for kind in ("package", *_KINDS)),
    "enable_foreign_mappings",
}
# Pairs with other names in ROS 2, as the mapping files of ROS 2's own packages have them.
_USUAL: Final = {
    "rosgraph_msgs/Log": "rcl_interfaces/msg/Log",
    "tf/tfMessage": "tf2_msgs/msg/TFMessage",
    "rospy_tutorials/AddTwoInts": "example_interfaces/srv/AddTwoInts",
    "roscpp_tutorials/TwoInts": "example_interfaces/srv/AddTwoInts",
    "roscpp/Empty": "std_srvs/srv/Empty",
    "actionlib_tutorials/Fibonacci": "example_interfaces/action/Fibonacci",
}
# Stands between an action's name and those of its services and topics in ROS 2.
PART: Final = "/_action/"
# What the definition of an action is made of.
_GOAL_PARTS: Final = ("Goal", "Result", "Feedback")
CANCEL_TYPE: Final = "action_msgs/srv/CancelGoal"
STATUS_TYPE: Final = "action_msgs/msg/GoalStatusArray"
_UUID: Final = ("goal_id", (Nodetype.NAME, "unique_identifier_msgs/msg/UUID"))
_TIME: Final = ("stamp", (Nodetype.NAME, "builtin_interfaces/msg/Time"))
_INFO: Final = (Nodetype.NAME, "action_msgs/msg/GoalInfo")
_LOG: Final = "rosgraph_msgs/Log"
_LOG_FIELDS: Final[FieldPaths] = {
    "header.stamp": "stamp",
    **{name: name for name in ("level", "name", "msg", "file", "function", "line")},
}


class TypeMapping:
    """The rules of all mapping files; a later file's rule replaces an earlier one of the same type."""

    def __init__(self) -> None:
        self._types: dict[str, dict[str, TypePair]] = {kind: {} for kind in _KINDS.values()}
        self._packages: dict[str, list[str]] = {}

    def read(self, path: Path) -> None:
        """Take in a mapping file.

        Raises:
            ConfigError: It cannot be read, or a rule is wrong; the error names the rule.
        """
        try:
            check_writers(path, os.environ, "gateway.ros2.mapping")
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
        if (found := self._types["msg"].get(name)) is not None:
            return found
        if _USUAL.get(name) in known:
            return TypePair(_USUAL[name], {"": _LOG_FIELDS} if name == _LOG else {})
        return next((TypePair(each) for each in self._candidates(name, "msg") if each in known), None)

    def counterpart(self, name: str, kind: str) -> TypePair:
        """The ROS 2 type of a service (``srv``) or ``action`` of ROS 1; without a rule the one of the same name."""
        return self._types[kind].get(name) or TypePair(_USUAL.get(name) or self._candidates(name, kind)[0])

    def has_service_rule(self, name: str) -> bool:
        """Whether a mapping file has a rule for a service type of ROS 1 or its package."""
        return name in self._types["srv"] or name.partition("/")[0] in self._packages

    def _candidates(self, name: str, kind: str) -> list[str]:
        package, _, base = name.partition("/")
        packages = [*self._packages.get(package, ()), package]
        if package.endswith("_msgs"):
            packages.append(package.removesuffix("_msgs") + "_interfaces")
        return [f"{each}/{kind}/{base}" for each in packages]

    def ros1_type(self, name: str, known: Iterable[str] = ()) -> str:
        """The ROS 1 type of a message, service or action type of ROS 2; the same name without a rule.

        Args:
            name: ``package/msg/Name`` of ROS 2, likewise ``srv`` and ``action``.
            known: ROS 1 types that are known here; one of them wins if several stand for the type.
        """
        package, kind, base = name.split("/")
        known, same = set(known), f"{package}/{base}"
        ruled = [ros1 for ros1, pair in self._types[kind].items() if pair.name == name]
        usual = [ros1 for ros1, ros2 in _USUAL.items() if ros2 == name]
        packages = [f"{ros1}/{base}" for ros1, all_of in self._packages.items() if package in all_of]
        found = [*ruled, *([same] if same in known else []), *usual, *packages, same]
        return next((each for each in found if each in known), found[0])

    def _add(self, rule: Any) -> str:
        """Take in one rule; return what is wrong with it, or an empty text."""
        if not isinstance(rule, dict):
            return "is not a mapping"
        if unknown := [str(key) for key in rule if key not in _KEYS]:
            return f"has the unknown key {min(unknown)!r}"
        if wrong := [key for key, each in rule.items() if key.endswith("_name") and not isinstance(each, str)]:
            return f"has no text as {wrong[0]}"
        package1, package2 = rule.get("ros1_package_name"), rule.get("ros2_package_name")
        if package1 is None or package2 is None:
            return "needs ros1_package_name and ros2_package_name"
        for kind, short in _KINDS.items():
            keys = f"ros1_{kind}_name", f"ros2_{kind}_name"
            name1, name2 = map(rule.get, keys)
            if (name1 is None) != (name2 is None):
                return f"needs both {keys[0]} and {keys[1]}, or none of them"
            if name1 is not None:
                ros1 = f"{package1}/{name1}"
                if not is_type_name(ros1) or not is_type_name(f"{package2}/{name2}"):
                    return f"maps {ros1!r} to {package2}/{name2}: not a name of a type"
                paths = {part: rule[key] for key, part in _FIELD_KEYS.items() if rule.get(key) is not None}
                if wrong := [
                    key for key, part in _FIELD_KEYS.items() if part in paths and not _is_paths(paths[part])
                ]:
                    return f"has no mapping of fields to fields as {wrong[0]}"
                self._types[short][ros1] = TypePair(f"{package2}/{short}/{name2}", paths)
                return ""
        if not _FIELD_KEYS.keys().isdisjoint(rule):
            return "maps fields, but names no message, service or action"
        self._packages.setdefault(package1, []).append(package2)
        return ""


def _is_paths(fields: Any) -> bool:
    return isinstance(fields, dict) and all(isinstance(each, str) for pair in fields.items() for each in pair)


# The ROS 1 definition of a type that only ROS 2 defines. A node of ROS 1 can ask for it by name.


_TIMES: Final = {ros2: ros1 for ros1, ros2 in TIMES.items()}


def derive_ros1(store: Typestore, name: str, name1: Callable[[str], str]) -> MessageType:
    """Make the ROS 1 form of a type of ROS 2.

    Times become ``time`` and ``duration``, bounds are left out, and an embedded type that ROS 1 defines too is
    ROS 1's: a header has ``seq``.

    Args:
        store: The types of ROS 2.
        name: ``package/msg/Name``.
        name1: The name of ROS 1 for one of ROS 2's types.

    Raises:
        KeyError: An embedded type is not known.
        DefinitionError: It has a field that ROS 1 cannot have.
    """
    own = name1(name)
    texts = _texts(store, [name], name1)
    blocks = [texts.pop(own), *(f"{SEPARATOR}\nMSG: {key}\n{text}" for key, text in texts.items())]
    return MessageType.learn(own, "\n".join(blocks))


def derive_service(store: Typestore, name: str, own: str, name1: Callable[[str], str]) -> ServiceType:
    """Make the ROS 1 form of a service type of ROS 2; fields and errors as for ``derive_ros1``.

    Args:
        store: The types of ROS 2, with request and response of the service.
        name: ``package/srv/Name``.
        own: ``package/Name`` of ROS 1.
        name1: The name of ROS 1 for one of ROS 2's message types.
    """
    halves = {f"{name}_Request": f"{own}Request", f"{name}_Response": f"{own}Response"}
    texts = _texts(store, list(halves), lambda each: halves.get(each) or name1(each))
    return ServiceType(own, "\n---\n".join(texts.pop(half) for half in halves.values()), texts.get)


def _texts(store: Typestore, names: Sequence[str], name1: Callable[[str], str]) -> dict[str, str]:
    """The own texts of some types, and of all that they embed, by their names of ROS 1."""
    texts: dict[str, str] = {}
    todo = list(names)
    while todo:
        each = todo.pop()
        key = name1(each)
        if key in texts:
            continue
        text = known_text(key) if each not in names else None
        if text is not None:  # ROS 1's type may embed others, which rmpa brings too
            todo += [ros2_name(inner) for inner in MessageType(key).specifications if inner != key]
        else:
            constants, described = store.fielddefs[each]
            lines = [f"{kind} {label}={value}" for label, kind, value in constants]
            for field in ros2_fields(described):
                kind = field.type if field.primitive else _TIMES.get(field.type) or name1(field.type)
                if field.name != EMPTY_MEMBER:
                    lines.append(f"{replace(field, type=kind)} {field.name}")
                if not field.primitive and field.type not in _TIMES:
                    todo.append(field.type)
            text = "\n".join(lines)
        texts[key] = text
    return texts


class Ros2Pairs:
    """The pairs of types of one ROS 2 domain.

    Args:
        types: ROS 2's types; what is learnt is added.
        mapping: The rules of the mapping files.
        find: Finds a ROS 1 type on this machine by its name; raises ``RmpaError`` if there is none.
    """

    def __init__(self, types: Ros2Types, mapping: TypeMapping, find: Callable[[str], MessageType]) -> None:
        self._types = types
        self.mapping = mapping
        self._find = find
        self._ros1: dict[str, MessageType] = {}
        self._variants: dict[tuple[str, str], Ros2Types] = {}
        self._learnt_fields = 0
        self._out: _Kept = {}
        self._in: _Kept = {}

    def ros2_type(self, name: str) -> tuple[str, str] | None:
        """The type of ROS 2 for a ROS 1 type, and its hash.

        Args:
            name: ``package/Name``.

        Returns:
            ``None`` if ROS 2 knows no such type: its definition must be learnt from a publisher (``learn``).

        Raises:
            NoConversion: A rule maps it to a type that is not known here.
        """
        pair = self.mapping.message(name, self._types)
        return None if pair is None else (pair.name, self._hash(name, pair))

    def learn(self, kind: MessageType) -> tuple[str, str]:
        """Take in a definition that a publisher sent, and return the type of ROS 2 and its hash.

        Raises:
            NoConversion: A rule maps it to a type that is not known here, or it is too large.
        """
        try:
            check_size(kind.name, lambda each: kind.specifications[each].fields)
        except RemoteProtocolError as error:
            raise NoConversion(f"{kind.name} has no form in ROS 2: {error}") from error
        if len(self._ros1) < limits.ROS2_TYPES_MAX:
            self._ros1[kind.name] = kind
        if (known := self.ros2_type(kind.name)) is not None:
            return known
        name = ros2_name(kind.name)
        try:
            self._types.learn(kind.specifications)
            return name, self._types.type_hash(name)
        except (KeyError, TypesysError) as error:
            raise NoConversion(f"{kind.name} has no form in ROS 2: {error}") from error

    def outgoing(self, kind: MessageType) -> Conversion:
        """The conversion of a ROS 1 type, by the pair that ``learn`` finds.

        Raises:
            NoConversion: The types are no pair; the text says which fields differ, and what to write.
        """
        key = kind.name, kind.md5sum
        name = "" if key in self._out else self.learn(kind)[0]

        def make() -> Conversion:
            pair = self.mapping.message(kind.name, self._types)
            return Conversion(kind, name, self._types, pair.fields if pair is not None else None)

        return self._kept(self._out, key, make)

    def _hash(self, name: str, pair: TypePair) -> str:
        try:
            return self._types.type_hash(pair.name)
        except KeyError:
            raise NoConversion(
                f"a rule maps {name} to {pair.name}, which is not known here: let a ROS 2 node that has it offer "
                "get_type_description, or map it to another type"
            ) from None

    def ros1_name(self, name: str) -> str:
        """The name of ROS 1 for a type of ROS 2, ``package/msg/Name``."""
        return self.mapping.ros1_type(name, (*known_types(), *self._ros1))

    def incoming(self, name: str, type_hash: str) -> Conversion | None:
        """The conversion of a type of ROS 2.

        Args:
            name: ``package/msg/Name``.
            type_hash: The hash that its publisher has.

        Returns:
            ``None`` if the fields behind this hash are not known: a node must describe them (``described``).

        Raises:
            NoConversion: The types are no pair; the text says which fields differ, and what to write.
        """
        types = self._types_of(name, type_hash) if (name, type_hash) not in self._in else self._types
        if types is None:
            return None
        return self._kept(self._in, (name, type_hash), lambda: self._make_incoming(name, types))

    def described(self, name: str, type_hash: str, fields: Mapping[str, Any]) -> None:
        """Take in what a ROS 2 node says of a type.

        Args:
            name: ``package/msg/Name``.
            type_hash: The hash that its publisher has.
            fields: The fields of the type and of all that it embeds, in rosbags' form.

        Raises:
            NoConversion: The fields have another hash, or are too many.
        """
        if len(self._variants) >= limits.ROS2_TYPES_MAX:
            raise NoConversion(f"{limits.ROS2_TYPES_MAX} types of ROS 2 were learnt already; {name} is not")
        if self._learnt_fields >= limits.ROS2_LEARNT_FIELDS_MAX:
            raise NoConversion(f"{self._learnt_fields} fields of ROS 2 were learnt already; {name} is not")
        variant = described_types(self._types, name, type_hash, fields)
        self._learnt_fields += sum(1 + len(each[1]) for each in fields.values())
        self._variants[name, type_hash] = variant
        if name not in self._types:  # so the mesh's own topics can have the type too
            self._types.take(fields)

    def _types_of(self, name: str, type_hash: str) -> Ros2Types | None:
        """The types that have the fields behind a hash."""
        if (variant := self._variants.get((name, type_hash))) is not None:
            return variant
        if name not in self._types:
            ros1 = self._ros1_type(self.ros1_name(name))
            if ros1 is None or ros2_name(ros1.name) != name:
                return None
            variant = self._types.variant({})
            try:
                variant.learn(ros1.specifications)
                if variant.type_hash(name) != type_hash:
                    return None
                self._types.learn(ros1.specifications)
            except (KeyError, TypesysError):
                return None
        return self._types if self._types.type_hash(name) == type_hash else None

    def _make_incoming(self, name: str, types: Ros2Types) -> Conversion:
        name1 = self.ros1_name(name)
        ros1 = self._ros1_type(name1)
        if ros1 is None:
            try:
                ros1 = derive_ros1(types.store, name, self.ros1_name)
            except (RmpaError, KeyError) as error:
                raise NoConversion(f"{name} has no form in ROS 1: {error}") from error
        pair = self.mapping.message(name1, types.store.fielddefs)
        return Conversion(ros1, name, types, pair.fields if pair is not None and pair.name == name else None)

    def _ros1_type(self, name: str) -> MessageType | None:
        if (learnt := self._ros1.get(name)) is not None:
            return learnt
        try:
            return self._find(name)
        except RmpaError:
            return None

    @staticmethod
    def _kept(into: _Kept, key: tuple[str, str], make: Callable[[], Conversion]) -> Conversion:
        """What was made before for a key, or is made now; a failure is kept too, and raised again."""
        if key not in into:
            if len(into) >= limits.ROS2_TYPES_MAX:
                del into[next(iter(into))]
            try:
                into[key] = make()
            except NoConversion as error:
                into[key] = error
            except (DefinitionError, KeyError) as error:
                into[key] = NoConversion(f"{key[0]} cannot be converted: {error}")
        kept = into[key]
        if isinstance(kept, NoConversion):
            raise kept.with_traceback(None)
        return kept


def described_types(types: Ros2Types, name: str, type_hash: str, fields: Mapping[str, Any]) -> Ros2Types:
    """The types of ROS 2 with what one of its nodes says of one; arguments and errors are those of ``described``."""
    if name not in fields:
        raise NoConversion(f"the node that has {name} described other types")
    try:
        variant = types.variant(fields)
        hashed = variant.type_hash(name)
    except (KeyError, RecursionError, TypesysError) as error:
        raise NoConversion(f"the description of {name} is not complete: {error}") from error
    if hashed != type_hash:
        raise NoConversion(f"the description of {name} has the type hash {hashed}, its endpoint {type_hash}")
    return variant


async def find_types(*names: str) -> list[MessageType]:
    """Find types of ROS 1; raises ``RmpaError`` if a definition is missing."""
    return [await asyncio.to_thread(find_message_type, name) for name in names]


class ServicePair:
    """Converts the calls of one service type.

    Args:
        ros1: The type of ROS 1.
        pair: Its counterpart.
        types: ROS 2's types; the service type is learnt from ROS 1's fields if it is not known.

    Attributes:
        type_hash: The hash in keys and tokens.
        request: Converts requests.
        response: Converts responses.

    Raises:
        NoConversion: The types are no pair.
    """

    derive = staticmethod(derive_service)

    @staticmethod
    async def find(name: str) -> ServiceType:
        """The type of ROS 1 on this machine; raises ``RmpaError`` if there is none."""
        return await asyncio.to_thread(find_service_type, name)

    def __init__(self, ros1: ServiceType, pair: TypePair, types: Ros2Types) -> None:
        if pair.paths and pair.name not in types:
            raise NoConversion(
                f"the rule of {ros1.name} maps fields to {pair.name}, whose definition is not known here: "
                "source the ROS 2 workspace that has it"
            )
        self.ros1 = ros1
        self.ros2 = pair.name
        self.type_hash = types.service_hash(ros1, pair.name)
        self.request = Conversion(ros1.request, f"{pair.name}_Request", types, pair.paths.get("request"))
        self.response = Conversion(ros1.response, f"{pair.name}_Response", types, pair.paths.get("response"))


class ActionPair:
    """Converts goals, results and feedback of one action type.

    Args:
        kinds: ROS 1's goal, result and feedback, without their wrapping.
        rule: Its counterpart, ``package/action/Name``, and the fields if a mapping file lists them.
        types: ROS 2's types; the action's are learnt from ROS 1's fields if they are not known.

    Attributes:
        name: ``package/action/Name`` of ROS 2.
        ros1: ``package/Name`` of ROS 1.
        types: The type of each service and topic in ROS 2, and its hash.
        type_hash: That of *send_goal*.
        goal: Converts goals, without the id.
        feedback: Converts feedback, without the id.
        result: ROS 1's result.
        no_result: A result of ROS 1 without values, for goals that have none.

    Raises:
        NoConversion: The types are no pair.
    """

    @staticmethod
    async def find(name: str) -> list[MessageType]:
        """Goal, result and feedback of an action of ROS 1 on this machine; errors as for ``find_types``."""
        return await find_types(*(f"{name}{part}" for part in _GOAL_PARTS))

    @staticmethod
    def derive(store: Typestore, name: str, own: str, name1: Callable[[str], str]) -> list[MessageType]:
        """Make these of an action of ROS 2; arguments and errors as for ``derive_service``."""
        ros1 = {f"{name}_{part}": f"{own}{part}" for part in _GOAL_PARTS}
        return [derive_ros1(store, each, lambda it: ros1.get(it) or name1(it)) for each in ros1]

    def __init__(self, kinds: Sequence[MessageType], rule: TypePair, types: Ros2Types) -> None:
        goal, result, feedback = kinds
        self.name: Final = rule.name
        self.ros1: Final = goal.name.removesuffix("Goal")
        if rule.paths and f"{rule.name}_Goal" not in types:
            raise NoConversion(
                f"the rule of {self.ros1} maps fields to {rule.name}, whose definition is not known here"
            )
        for part, kind in zip(_GOAL_PARTS, kinds, strict=True):
            types.learn({name: each for name, each in kind.specifications.items() if name != kind.name})
            types.define_as(f"{rule.name}_{part}", kind.specifications[kind.name])
        self.types: Final = _define(rule.name, types)
        self.type_hash: Final = self.types["send_goal"][1]
        self.goal: Final = Conversion(goal, f"{rule.name}_Goal", types, rule.paths.get("goal"))
        self.feedback: Final = Conversion(feedback, f"{rule.name}_Feedback", types, rule.paths.get("feedback"))
        self.result: Final = result
        wrapped = f"{self.ros1}GetResultResponse"
        both = Specification.parse(wrapped, f"int8 status\n{result.name} result\n")
        paths = rule.paths.get("result")
        if paths is not None:
            paths = {"status": "status", **{f"result.{one}": f"result.{two}" for one, two in paths.items()}}
        known = {**result.specifications, wrapped: both}
        self._result = Conversion(MessageType(wrapped, known), f"{rule.name}_GetResult_Response", types, paths)
        self.no_result: Final = result.serialize(result.make(None))

    def result_to_ros2(self, status: int, result: bytes) -> bytes:
        """``GetResult_Response``.

        Raises:
            ConversionError: The result does not fit ROS 2's type.
        """
        return self._result.to_ros2(bytes((status,)) + result)

    def result_to_ros1(self, raw: bytes) -> tuple[int, bytes]:
        """Status and result of a ``GetResult_Response``.

        Raises:
            ConversionError: The bytes are no such response.
        """
        made = self._result.to_ros1(raw)
        return made[0], made[1:]


def _define(name: str, types: Ros2Types) -> dict[str, tuple[str, str]]:
    """Define the types of one action of ROS 2, as rosidl_parser does."""
    own: dict[str, Any] = {part: (Nodetype.NAME, f"{name}_{part}") for part in _GOAL_PARTS}
    number = (Nodetype.BASE, ("int8", 0))
    sent = [("accepted", (Nodetype.BASE, ("bool", 0))), _TIME]
    types.define_service(f"{name}_SendGoal", [_UUID, ("goal", own["Goal"])], sent)
    types.define_service(f"{name}_GetResult", [_UUID], [("status", number), ("result", own["Result"])])
    types.take({f"{name}_FeedbackMessage": ([], [_UUID, ("feedback", own["Feedback"])])})
    cancelled = [("return_code", number), ("goals_canceling", (Nodetype.SEQUENCE, (_INFO, 0)))]
    types.define_service(CANCEL_TYPE, [("goal_info", _INFO)], cancelled)
    kinds = {
        "send_goal": f"{name}_SendGoal",
        "get_result": f"{name}_GetResult",
        "cancel_goal": CANCEL_TYPE,
        "feedback": f"{name}_FeedbackMessage",
        "status": STATUS_TYPE,
    }
    return {part: (kind, types.type_hash(kind)) for part, kind in kinds.items()}
