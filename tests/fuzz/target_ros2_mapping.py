"""Fuzz target: mapping files of ros1_bridge."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from rmpa.core.errors import ConfigError
from rmpa.gateway.ros2.pairs import TypeMapping

SEEDS: list[bytes] = [
    b"",
    b"-\n  ros1_package_name: 'a_msgs'\n  ros2_package_name: 'b_interfaces'\n",
    (
        b"-\n  ros1_package_name: a_msgs\n  ros1_message_name: Foo\n  ros2_package_name: b\n"
        b"  ros2_message_name: Bar\n  fields_1_to_2:\n    header.stamp: stamp\n    foo: bar\n"
    ),
    (
        b"-\n  ros1_package_name: a\n  ros1_service_name: Do\n  ros2_package_name: b\n  ros2_service_name: Do\n"
        b"  request_fields_1_to_2: {x: y}\n  response_fields_1_to_2: {}\n  enable_foreign_mappings: true\n"
    ),
    b"&a [*a]\n",
    b"[[[[{",
]


def fuzz(data: bytes) -> None:
    """A file that gives a type for each name, or an error that names the file."""
    handle, name = tempfile.mkstemp()
    path = Path(name)
    try:
        os.write(handle, data[:1024])  # YAML is read slowly
        os.close(handle)
        mapping = TypeMapping()
        try:
            mapping.read(path)
        except ConfigError as error:
            if str(path) not in str(error):
                raise AssertionError("the error does not name the file") from error
    finally:
        path.unlink()
    for ros1 in ("a_msgs/Foo", "a/Do", "std_msgs/String"):
        pair = mapping.message(ros1, frozenset(("std_msgs/msg/String", "b/msg/Do")))
        for each in (mapping.counterpart(ros1, "srv"), *((pair,) if pair is not None else ())):
            if each.name.count("/") != 2 or "/" not in mapping.ros1_type(each.name):
                raise AssertionError(f"{ros1} has the pair {each}")
