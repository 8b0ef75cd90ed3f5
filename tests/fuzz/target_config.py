"""Fuzz target: the settings file, and each value in it."""

from __future__ import annotations

import contextlib
from pathlib import Path

from rmpa.core import config_values as values
from rmpa.core.config_file import known_keys, parse_config
from rmpa.core.errors import ConfigError

_EXAMPLE = Path(__file__).parents[2] / "examples" / "rmpa.toml"
_READERS = (
    values.read_name,
    values.read_bool,
    values.read_domain,
    values.read_port_or_any,
    values.read_level,
    values.read_host_port,
    values.read_interface,
    values.read_multicast,
    values.read_topic_glob,
    values.read_type_glob,
    lambda raw: values.read_list(raw, values.read_host_port),
)

SEEDS: list[bytes] = [
    b"".join(line for line in _EXAMPLE.read_bytes().splitlines(keepends=True) if not line.startswith(b"#")),
    b'name = "robot_1"\n[core]\nport = 1\n[discovery]\nseeds = ["10.0.0.1:1",\n"far"]\nmulticast = false\n',
    b'core.port = 1_1\nbridge = {allow = ["/**"]}\nlog.level = """\ninfo"""\n',
    b"domain = 1979-05-27T07:32:00Z\n[[mesh]]\nport = inf\n",
    b"",
    b"239.255.82.77:11411",
    b"/camera/**",
    b"sensor_msgs/*",
    b"10.0.0.1:40001;far.example.org",
]


def fuzz(data: bytes) -> None:
    """Known keys or a ConfigError that names a line of the file; a value or a BadValue."""
    try:
        found = parse_config(data, Path("rmpa.toml"))
        if not set(found) <= set(known_keys()):
            raise AssertionError(f"unknown keys came through: {set(found) - set(known_keys())}")
    except ConfigError as error:
        if error.line is not None and not 1 <= error.line <= data.count(b"\n") + 1:
            raise AssertionError(f"line {error.line} is not in the file") from error
        str(error)
    text = data[:200].decode("utf-8", "replace")
    for read in _READERS:
        with contextlib.suppress(values.BadValue):
            read(text)
