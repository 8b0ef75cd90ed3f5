"""Which type of ROS 2 stands for a type of ROS 1: by name, and by ros1_bridge's mapping files.

A mapping file is a YAML list of rules (ros1_bridge's doc/index.rst): of packages (``ros1_package_name``,
``ros2_package_name``), of messages (also ``ros1_message_name``, ``ros2_message_name``) or services
(``…_service_name``), and of fields (also ``fields_1_to_2``; ``request_fields_1_to_2`` and
``response_fields_1_to_2`` of services). A path of fields has dots: ``header.stamp``. ros1_bridge has no actions;
their keys are made as its others are.
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

# A field of ROS 1 to one of ROS 2, each a path with dots.
FieldPaths = dict[str, str]
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
_LOG: Final = "rosgraph_msgs/Log"
_LOG_FIELDS: Final[FieldPaths] = {
    "header.stamp": "stamp",
    **{name: name for name in ("level", "name", "msg", "file", "function", "line")},
}


@dataclass(frozen=True, slots=True)
class TypePair:
    """A type of ROS 2 for one of ROS 1.

    Args:
        name: ``package/msg/Name``, ``package/srv/Name`` or ``package/action/Name``.
        paths: The fields by path, if a rule lists them, else they go by name. Of a message they are under ``""``, of
            a service under ``request`` and ``response``, of an action under ``goal``, ``result`` and ``feedback``.
    """

    name: str
    paths: Mapping[str, FieldPaths] = field(default_factory=dict)

    @property
    def fields(self) -> FieldPaths | None:
        """The fields of a message, if a rule lists them."""
        return self.paths.get("")


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
            rules = yaml.safe_load(path.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
            raise ConfigError("gateway.ros2.mapping", f"cannot be read: {error}", path=path) from error
        if not isinstance(rules, list):
            raise ConfigError("gateway.ros2.mapping", "is not a list of rules", "as ros1_bridge has them", path=path)
        for number, rule in enumerate(rules, 1):
            if problem := self._add(rule):
                raise ConfigError("gateway.ros2.mapping", f"rule {number} {problem}", path=path)

    # --- from ROS 1 to ROS 2 ---------------------------------------------------------------------------------------

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

    def service(self, name: str) -> TypePair:
        """The ROS 2 type of a service type; without a rule the one of the same name."""
        return self._types["srv"].get(name) or TypePair(_USUAL.get(name) or self._candidates(name, "srv")[0])

    def action(self, name: str) -> TypePair:
        """The ROS 2 type of an action type, ``package/Name`` of ROS 1; without a rule the one of the same name."""
        return self._types["action"].get(name) or TypePair(_USUAL.get(name) or self._candidates(name, "action")[0])

    def has_service_rule(self, name: str) -> bool:
        """Whether a mapping file has a rule for a service type of ROS 1 or its package."""
        return name in self._types["srv"] or name.partition("/")[0] in self._packages

    def _candidates(self, name: str, kind: str) -> list[str]:
        package, _, base = name.partition("/")
        packages = [*self._packages.get(package, ()), package]
        if package.endswith("_msgs"):
            packages.append(package.removesuffix("_msgs") + "_interfaces")
        return [f"{each}/{kind}/{base}" for each in packages]

    # --- from ROS 2 to ROS 1 ---------------------------------------------------------------------------------------

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

    # --- reading rules ---------------------------------------------------------------------------------------------

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
