"""Fuzz target: the settings file, and each value in it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rmpa.bridge.messages import OpenRoute, decode, encode
from rmpa.bridge.policy import PeerNames
from rmpa.config import limits
from rmpa.config.peer_rules import PEER_RULES, PeerRule
from rmpa.config.read import parse_config
from rmpa.config.rules import CONTRACT_RULES, GATEWAY_RULES, PARAM_RULES
from rmpa.config.settings import SETTINGS
from rmpa.config.values import BadValue, read_bytes_a_second, read_duration, read_rate
from rmpa.core.contract import ContractRule, Contracts
from rmpa.core.errors import ConfigError
from rmpa.core.identity import is_global_name

_EXAMPLE = Path(__file__).parents[2] / "src" / "rmpa" / "config" / "rmpa.toml"
_READERS = (
    *(s.type.read for s in SETTINGS if not s.is_list_of_tables),
    read_duration,
    read_rate,
    read_bytes_a_second,
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
    b"".join(
        line.removeprefix(b"# ")
        for line in _EXAMPLE.read_bytes().partition(b"# [[contract]]")[2].partition(b"\n\n")[0].splitlines(True)
    ).join([b"[[contract]]", b""]),
    b'[[contract]]\ntopics = ["/a/**"]\ntypes = ["a/B", "std_msgs/*"]\ndepth = 5\nhistory = "keep_all"\n',
    b'[[contract]]\ntopics = ["/**"]\nliveliness = "manual_by_topic"\nliveliness_lease_duration = "1.5 s"\n',
    b'contract = [{topics = "/a;/b", max_rate = "10 Hz", deadline = 1e-3, lifespan = inf, priority = "LOW"}]\n',
    b"[[contract]]\ntopics = ['/a']\ntransport = 'auto'\n",
    b"[[contract]]\ntypes = ['*/*']\nreliability = 'reliable'\ndurability = 'transient_local'\ndepth = 100_000\n",
    b"[[contract]]\ntopics = ['/**']\ndeadline = 1e-9\nlifespan = 1e9\nmax_rate = 1e-9\ndepth = 0\n",
    b"[[contract]]\ntopics = ['/**']\nlifespan = '86401 s'\n",
    b'[[param]]\nkey = "/a/b"\nfrom = "base"\nto = "/c"\n[[param]]\nkey = "c/d"\nfrom = "arm"\n[time]\nfollow = ""\n',
    b'[[peer]]\nname = "robot*"\nprefix = "/{peer}"\nremap_in = {"/tf" = "/tf", "/arm/**" = "/{peer}/left/**"}\n',
    b'[[peer]]\nname = "*"\nallow = ["/{peer}/**"]\nremap_out = {"/a" = "/b", "/b" = "/a"}\n',
    b'[[peer]]\nname = "*"\n[peer.remap_in]\n"/**" = "/a/**"\n"/b/**" = "/**"\n',
    b'[gateway]\nsite = "a"\nconnect = ["tls/a:7447"]\n[gateway.ros2]\nenabled = true\nmapping = ["a.yaml"]\n',
    b'[[gateway.rule]]\nnames = ["/a/**"]\nsize = "1 Mbit/s"\n[[gateway.rule]]\nname = "/{site}/{module}{name}"\n',
    b"[gateway]\nros2.domain = 3\nrule = [{crossing = 'in', name = '{name}'}, {sites = ['*'], rate = 0}]\n",
    b"tcp/[fe80::1%eth0]:7447#iface=eth0",
    b"1.5 Mbit/s",
    b"100 ms",
    b"86400.000000000 s",
    b"infinite",
    b"1000000 Hz",
]


_TABLES = {
    ("contract",): CONTRACT_RULES,
    ("param",): PARAM_RULES,
    ("peer",): PEER_RULES,
    ("gateway", "rule"): GATEWAY_RULES,
}


def fuzz(data: bytes) -> None:
    """Known keys or a ConfigError that names a line of the file; rules and values, or a BadValue that says where."""
    try:
        found = parse_config(data, Path("rmpa.toml"))
        tables = {key: found.pop(key, []) for key in _TABLES}
        if unknown := set(found) - {setting.key for setting in SETTINGS}:
            raise AssertionError(f"unknown keys came through: {unknown}")
        for key, raw in tables.items():
            _check(_TABLES[key].read, raw)
    except ConfigError as error:
        if error.line is not None and not 1 <= error.line <= data.count(b"\n") + 1:
            raise AssertionError(f"line {error.line} is not in the file") from error
        str(error)
    text = data[:200].decode("utf-8", "replace")
    for read in _READERS:
        with contextlib.suppress(BadValue):
            read(text)


def _check(read: Callable[[Any], Any], raw: Any) -> None:
    """Rules whose contract a peer would take and whose names are names of ROS, or a BadValue that says where."""
    try:
        rules = read(raw)
    except BadValue as error:
        if error.at == () and isinstance(raw, list) and len(raw) <= limits.FOLLOW_RULES_MAX:
            raise AssertionError("a wrong rule, but nothing says which") from error
        return
    if rules and isinstance(rules[0], ContractRule):
        message = OpenRoute(7, "/a/b", "/n", Contracts(rules).of("/a/b", "a/B"))
        if decode(encode(message)) != message:
            raise AssertionError(f"{message} does not survive its way to a peer")
    if rules and isinstance(rules[0], PeerRule):
        names = PeerNames("robot1", rules)
        for name in ("/a", "/a/b", "/arm/joints", "/tf"):
            if not (is_global_name(names.local_name(name)) and is_global_name(names.wire_name(name))):
                raise AssertionError(f"{name} becomes no name")
