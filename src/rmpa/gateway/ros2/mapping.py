"""Which type of ROS 2 stands for a type of ROS 1: by name, and by ros1_bridge's mapping files.

A mapping file is a YAML list of rules (ros1_bridge's doc/index.rst): of packages (``ros1_package_name``,
``ros2_package_name``), of messages (also ``ros1_message_name``, ``ros2_message_name``) or services
(``…_service_name``), and of fields (also ``fields_1_to_2``; ``request_fields_1_to_2`` and
``response_fields_1_to_2`` of services). A path of fields has dots: ``header.stamp``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import yaml

from rmpa.core.errors import ConfigError
from rmpa.core.identity import is_type_name

if TYPE_CHECKING:
    from collections.abc import Container, Iterable, Mapping
    from pathlib import Path

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
