"""Settings: every source, their order, and what each mistake is told."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from errno import EACCES
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.config import limits
from rmpa.config.peer_rules import PolicySettings
from rmpa.config.read import Loaded, find_config_file, line_of, load_settings, parse_config
from rmpa.config.rules import GatewaySettings, Ros2Settings
from rmpa.config.settings import (
    SETTINGS,
    LaneSettings,
    LimitSettings,
    RealtimeSettings,
    Settings,
    TrustSettings,
    WebSettings,
)
from rmpa.config.values import HostPort, Multicast
from rmpa.core import limits as core_limits
from rmpa.core.contract import ContractRule
from rmpa.core.errors import ConfigError
from tests.core.example import EXAMPLE, uncommented

Load = Callable[..., Loaded]
Refuse = Callable[..., str]


@pytest.fixture
def load(tmp_path: Path) -> Load:
    def load(
        text: str | None = None,
        *,
        options: dict[str, object] | None = None,
        environ: dict[str, str] | None = None,
        host_name: str = "base",
    ) -> Loaded:
        if text is not None:
            (tmp_path / "rmpa.toml").write_text(text)
        return load_settings(options or {}, environ or {}, host_name=host_name, cwd=tmp_path)

    return load


@pytest.fixture
def refuse(load: Load, tmp_path: Path) -> Refuse:
    def refuse(text: str | None = None, **kwargs: object) -> str:
        with pytest.raises(ConfigError) as info:
            load(text, **kwargs)
        return str(info.value).removeprefix(f"{tmp_path}/")

    return refuse


def test_defaults_and_the_host_name_without_any_source(load: Load) -> None:
    assert load(host_name="my-robot.local").settings == Settings(name="my_robot")


def test_the_example_says_the_defaults(load: Load) -> None:
    settings = load(EXAMPLE.read_text()).settings
    assert settings == Settings(name="base", config_file=settings.config_file)


def test_the_example_shows_every_key_and_its_commented_lines_load() -> None:
    lines = EXAMPLE.read_text().partition("# [[")[0].split("\n")
    shown = [line.removeprefix("# ") if line.startswith("# ") and " = " in line else line for line in lines]
    # A commented alternative takes the place of the default above it.
    kept: dict[tuple[str, str], str] = {}
    table = ""
    for line in shown:
        table = line if line.startswith("[") else table
        if " = " in line and not line.startswith("#"):
            kept[table, line.split(" = ")[0]] = line
    text = ""
    for name in dict.fromkeys(t for t, _ in kept):
        text += name + "\n" + "\n".join(line for (t, _), line in kept.items() if t == name) + "\n"
    assert set(parse_config(text.encode(), None)) == {s.key for s in SETTINGS if s.key and not s.is_list_of_tables}


def test_the_examples_lists_of_tables_load_and_show_every_key(load: Load) -> None:
    text = uncommented(EXAMPLE.read_text())
    found = parse_config(text.encode(), None)
    for setting in (setting for setting in SETTINGS if setting.is_list_of_tables):
        tables = found[setting.key]
        assert isinstance(tables, list)
        keys = setting.type.json_schema["items"]["properties"]
        assert {key for table in tables for key in table} == set(keys), setting.title
    assert load(text).notes == ()


def test_each_source_outweighs_the_one_before(load: Load) -> None:
    text = 'domain = 2\nname = "from_file"\n[mesh]\nport = 2\n[core]\nport = 2222\n'
    environ = {
        "ROS_DOMAIN_ID": "1",
        "ROS_MASTER_URI": "http://localhost:1111",
        "RMPA_PORT": "3",
        "RMPA_NAME": "from_var",
    }
    settings = load(text, environ=environ, options={"name": "from_flag"}).settings
    assert (settings.domain, settings.core_port, settings.port, settings.name) == (2, 2222, 3, "from_flag")


def test_a_full_file(load: Load) -> None:
    settings = load(
        """
name = "robot_1"
domain = 7
[core]
host = "0.0.0.0"
port = 11312
[mesh]
port = 40001
[discovery]
interfaces = ["wlan0"]
seeds = ["10.0.0.5:40001", "far.example.org"]
multicast = "239.1.2.3:5000"
[bridge]
allow = ["/cmd/**"]
deny = ["/cmd/secret"]
allow_types = ["sensor_msgs/*"]
deny_types = ["sensor_msgs/Image"]
[[contract]]
topics = ["/cmd/**"]
depth = 1
[limits]
nodes = 7
topics = 8
services = 9
params = 10
[lanes]
express_dscp = 46
express_priority = 5
bulk_dscp = 8
bulk_priority = 1
[realtime]
enabled = true
priority = 80
lock_memory = false
[log]
level = "debug"
json = true
"""
    ).settings
    assert settings == Settings(
        name="robot_1",
        domain=7,
        core_host="0.0.0.0",
        core_port=11312,
        port=40001,
        interfaces=("wlan0",),
        seeds=(HostPort("10.0.0.5", 40001), HostPort("far.example.org")),
        multicast=Multicast(True, "239.1.2.3", 5000),
        policy=PolicySettings(("/cmd/**",), ("/cmd/secret",), ("sensor_msgs/*",), ("sensor_msgs/Image",)),
        contracts=(ContractRule(("/cmd/**",), (), {"depth": 1}),),
        limits=LimitSettings(7, 8, 9, 10),
        lanes=LaneSettings(46, 5, 8, 1),
        realtime=RealtimeSettings(True, 80, False),
        log_level="debug",
        log_json=True,
        config_file=settings.config_file,
    )


def test_every_flag(load: Load) -> None:
    options = {
        "name": "a",
        "core_host": "localhost",
        "core_port": "1",
        "core": "external",
        "master": "http://h:1",
        "keep": "never",
        "port": "2",
        "domain": "3",
        "interface": ("lo", "eth0"),
        "seed": ("h:1",),
        "multicast": "off",
        "prefix_peers": True,
        "log_level": "error",
        "log_json": True,
        "realtime": True,
        "web": True,
        "site": "warehouse",
        "rank": "7",
        "connect": ("tls/fleet.example:7447", "tcp/[::1]:7448"),
        "listen": ("tcp/0.0.0.0:7447",),
        "router": True,
        "insecure": True,
        "uplink": "1 Mbit/s",
        "ros2": True,
        "ros2_domain": "3",
        "ros2_distribution": "kilted",
        "ros2_mapping": ("a.yaml",),
    }
    assert set(options) == {setting.option_name for setting in SETTINGS if setting.option}
    settings = load(options=options).settings
    assert settings == Settings(
        name="a",
        core_host="localhost",
        core_port=1,
        core_mode="external",
        core_master="http://h:1",
        core_keep="never",
        port=2,
        domain=3,
        interfaces=("lo", "eth0"),
        seeds=(HostPort("h", 1),),
        multicast=Multicast(False),
        prefix_peers=True,
        log_level="error",
        log_json=True,
        trust=TrustSettings(insecure=True),  # rmpa gateway --insecure means its connections and its start
        realtime=RealtimeSettings(True),
        web=WebSettings(True),
        gateway=GatewaySettings(
            "warehouse",
            7,
            ("tls/fleet.example:7447", "tcp/[::1]:7448"),
            ("tcp/0.0.0.0:7447",),
            True,
            True,
            125_000,
            ros2=Ros2Settings(True, 3, "kilted", ("a.yaml",)),
        ),
    )


def test_external_core_is_ROS_MASTER_URI_unless_named(load: Load) -> None:  # noqa: N802
    environ = {"ROS_MASTER_URI": "http://robot:11312", "RMPA_CORE": "external"}
    loaded = load(environ=environ)
    assert loaded.settings == Settings(name="base", core_mode="external", core_master="http://robot:11312")
    assert loaded.notes == ()
    text = '[core]\nmode = "external"\nmaster = "http://other:1/"\nport = 11311\n'
    loaded = load(text, environ={"ROS_MASTER_URI": "http://robot:11312"})
    assert loaded.settings.core_master == "http://other:1/"
    assert loaded.notes == ()


def test_settings_of_the_other_kind_of_core_are_reported(load: Load) -> None:
    with pytest.raises(ConfigError, match=r"--master: is of no use with the embedded core; .*--core external"):
        load(options={"master": "http://h:1/"})
    with pytest.raises(ConfigError, match=r"'robot:11311' is not a master's URI.*did you mean .*http://robot:11311/"):
        load(environ={"RMPA_CORE": "external", "RMPA_MASTER": "robot:11311"})
    with pytest.raises(ConfigError, match=r"rmpa\.toml:2: core\.mode: 'extern' is not a kind.* \"external\""):
        load('[core]\nmode = "extern"\n')
    notes = load("", options={"core": "external", "core_port": "1", "keep": "never"}).notes
    assert notes == (
        "--core-port: is of no use with an external core",
        "--keep: is of no use with an external core",
    )


def test_what_is_gone_says_what_to_use(load: Load) -> None:
    with pytest.raises(ConfigError, match=r'rmpa\.toml:2: core\.fresh: an unknown key; write keep = "never"'):
        load("[core]\nfresh = true\n")
    with pytest.raises(ConfigError, match=r"RMPA_FRESH: is not a variable any more; set RMPA_KEEP=never"):
        load("", environ={"RMPA_FRESH": "1"})


def test_every_variable(load: Load) -> None:
    environ = {
        "RMPA_NAME": "a",
        "RMPA_DOMAIN": "3",
        "RMPA_CORE_HOST": "localhost",
        "RMPA_CORE_PORT": "1",
        "RMPA_PORT": "2",
        "RMPA_INTERFACES": "lo, eth0",
        "RMPA_SEEDS": "h:1;10.0.0.1",
        "RMPA_MULTICAST": "239.0.0.1",
        "RMPA_ALLOW": "/a;/b/**",
        "RMPA_DENY": "/c",
        "RMPA_ALLOW_TYPES": "std_msgs/*",
        "RMPA_DENY_TYPES": "std_msgs/Header",
        "RMPA_EXPRESS_DSCP": "46",
        "RMPA_EXPRESS_PRIORITY": "5",
        "RMPA_BULK_DSCP": "8",
        "RMPA_BULK_PRIORITY": "1",
        "RMPA_REALTIME": "1",
        "RMPA_REALTIME_PRIORITY": "80",
        "RMPA_REALTIME_LOCK_MEMORY": "no",
        "RMPA_LOG_LEVEL": "WARNING",
        "RMPA_LOG_JSON": "yes",
        "RMPA_RUNTIME_DIR": "/run/x",
        "RMPA_STATE_DIR": "/var/x",
        "RMPA_KEEP": "always",
        "RMPA_AGENT": "other",
    }
    loaded = load(environ=environ)
    assert loaded.notes == ()
    assert loaded.settings == Settings(
        name="a",
        domain=3,
        core_host="localhost",
        core_port=1,
        core_keep="always",
        port=2,
        interfaces=("lo", "eth0"),
        seeds=(HostPort("h", 1), HostPort("10.0.0.1")),
        multicast=Multicast(True, "239.0.0.1"),
        policy=PolicySettings(("/a", "/b/**"), ("/c",), ("std_msgs/*",), ("std_msgs/Header",)),
        lanes=LaneSettings(46, 5, 8, 1),
        realtime=RealtimeSettings(True, 80, False),
        log_level="warning",
        log_json=True,
        runtime_dir="/run/x",
        state_dir="/var/x",
    )


@pytest.mark.parametrize(
    ("environ", "expected"),
    [
        ({"ROS_DOMAIN_ID": "9"}, Settings(name="base", domain=9)),
        ({"ROS_DOMAIN_ID": ""}, Settings(name="base")),
        ({"ROS_MASTER_URI": "http://localhost:11312/"}, Settings(name="base", core_port=11312)),
        ({"ROS_MASTER_URI": "http://127.0.1.1:11312"}, Settings(name="base", core_port=11312)),
        ({"ROS_MASTER_URI": "http://BASE:11312"}, Settings(name="base", core_port=11312)),
        ({"ROS_MASTER_URI": "http://10.0.0.1:11312", "ROS_IP": "10.0.0.1"}, Settings(name="base", core_port=11312)),
        (
            {"ROS_STATIC_PEERS": "10.0.0.1;far:40001;"},
            Settings(name="base", seeds=(HostPort("10.0.0.1"), HostPort("far", 40001))),
        ),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, Settings(name="base")),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT"}, Settings(name="base")),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}, Settings(name="base", interfaces=("lo",))),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "off"}, Settings(name="base", multicast=Multicast(False))),
    ],
)
def test_the_ros_environment(load: Load, environ: dict[str, str], expected: Settings) -> None:
    loaded = load(environ=environ)
    assert (loaded.settings, loaded.notes) == (expected, ())


@pytest.mark.parametrize(
    ("environ", "note"),
    [
        ({"ROS_MASTER_URI": "http://10.9.9.9:11311"}, "names another machine"),
        ({"ROS_MASTER_URI": "localhost"}, "one looks like http://localhost:11311"),
        ({"ROS_MASTER_URI": "http://localhost:99999999"}, "one looks like http://localhost:11311"),
        ({"RMPA_DOMIAN": "1"}, "did you mean RMPA_DOMAIN?"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF", "ROS_STATIC_PEERS": "a"}, "as in ROS 2"),
    ],
)
def test_what_is_ignored_is_noted(load: Load, environ: dict[str, str], note: str) -> None:
    (text,) = load(environ=environ).notes
    assert note in text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("domian = 3", "rmpa.toml:1: domian: an unknown key; did you mean domain?"),
        ("\n\n[coer]\nport = 1", "rmpa.toml:3: coer: an unknown table; did you mean core?"),
        ("[core]\n# a comment\nprot = 1", "rmpa.toml:3: core.prot: an unknown key; did you mean core.port?"),
        ('seeds = ["a"]', "rmpa.toml:1: seeds: an unknown key; seeds belongs in [discovery]"),
        ("[core]\ndomain = 1", "rmpa.toml:2: core.domain: an unknown key; domain belongs above the first table"),
        ("[log]\nxyzzy = 1", "rmpa.toml:2: log.xyzzy: an unknown key; known here: level, json"),
        ("[core]\n\nport = '1'", "rmpa.toml:3: core.port: '1' is not a whole number"),
        ("[log]\njson = 1", "rmpa.toml:2: log.json: 1 is not true or false"),
        ("core = 5", "rmpa.toml:1: core: 5 is not a table"),
        ("[core]\nport = 70000", "rmpa.toml:2: core.port: 70000 is out of range; a port is between 1 and 65535"),
        ("[core]\nport = 0", "rmpa.toml:2: core.port: 0 is out of range; a port is between 1 and 65535"),
        ("domain = 233", "rmpa.toml:1: domain: 233 is out of range; a domain id is between 0 and 232"),
        (
            'name = "robot-1"',
            (
                "rmpa.toml:1: name: 'robot-1' is not a ROS base name (a letter, then letters, digits and _); "
                'did you mean "robot_1"?'
            ),
        ),
        (
            '[discovery]\nseeds = [\n  "10.0.0.1",\n  # a comment\n  "10.0.0.300:1",\n]',
            (
                "rmpa.toml:5: discovery.seeds: '10.0.0.300:1' is not HOST:PORT: '10.0.0.300' is not an IPv4 address; "
                "one looks like 192.168.1.20"
            ),
        ),
        ('[discovery]\nseeds = ["a",\n1]', "rmpa.toml:3: discovery.seeds: 1 is not a text in quotes"),
        ('[discovery]\nseeds = ["a:1", "a:1"]', "rmpa.toml:2: discovery.seeds: 'a:1' is there twice; delete on"),
        ('[discovery]\nseeds = ["fe80::1"]', "rmpa.toml:2: discovery.seeds: 'fe80::1' is not HOST:PORT"),
        (
            '[discovery]\nmulticast = "10.0.0.1:5"',
            "rmpa.toml:2: discovery.multicast: 10.0.0.1 is not a multicast group",
        ),
        (
            '[discovery]\nmulticast = "239.0.0.1:x"',
            "rmpa.toml:2: discovery.multicast: '239.0.0.1:x' is not GROUP:PORT",
        ),
        (
            '[discovery]\nmulticast = "ff02::1"',
            "rmpa.toml:2: discovery.multicast: 'ff02' is not an IPv4 multicast group",
        ),
        (
            "[discovery]\nmulticast = 5",
            "rmpa.toml:2: discovery.multicast: 5 is not true or false or a text in quotes",
        ),
        (
            '[bridge]\nallow = ["cmd"]',
            "rmpa.toml:2: bridge.allow: 'cmd' matches no topic: topics begin with /; did you ",
        ),
        ('[bridge]\ndeny = ["/a b"]', "rmpa.toml:2: bridge.deny: '/a b' is not a glob over topics"),
        ('[bridge]\ndeny = ["/a//b"]', "rmpa.toml:2: bridge.deny: '/a//b' matches no topic: it has // in it"),
        (
            '[bridge]\nallow_types = ["Image"]',
            (
                "rmpa.toml:2: bridge.allow_types: 'Image' matches no message type: types have a package in front; "
                'did you mean "*/Image"?'
            ),
        ),
        ('[log]\nlevel = "wran"', "rmpa.toml:2: log.level: 'wran' is not a log level; the levels are debug, info, "),
        (
            "[lanes]\nexpress_priority = 7",
            "rmpa.toml:2: lanes.express_priority: 7 is out of range; SO_PRIORITY without CAP_NET_ADMIN is between 0",
        ),
        (
            "[lanes]\nbulk_dscp = 64",
            "rmpa.toml:2: lanes.bulk_dscp: 64 is out of range; a DSCP (the TOS byte / 4; CS6 is",
        ),
        (
            "[lanes]\nexpres_dscp = 1",
            "rmpa.toml:2: lanes.expres_dscp: an unknown key; did you mean lanes.express_dscp?",
        ),
        (
            "[realtime]\npriority = 0",
            "rmpa.toml:2: realtime.priority: 0 is out of range; a priority of SCHED_FIFO is be",
        ),
        ('[bridge]\nallow = ["/a", "/a"]', "rmpa.toml:2: bridge.allow: '/a' is there twice; delete one of them"),
        ("[realtime]\nenable = true", "rmpa.toml:2: realtime.enable: an unknown key; did you mean realtime.enabled"),
        ('[bridge]\nallow = "/a"', "rmpa.toml:2: bridge.allow: '/a' is not a list; did you mean [\"/a\"]?"),
        ("name = robot", 'rmpa.toml:1: the file: not TOML: Invalid value; texts need quotes: "robot"'),
        ("a = 1\na = 2", "rmpa.toml:2: the file: not TOML: Cannot overwrite a value"),
        ("name: robot", "rmpa.toml:1: the file: not TOML"),
        ("[core", "rmpa.toml:1: the file: not TOML: Expected ']'"),
        ("x = " + "[" * 5000, "rmpa.toml: the file: lists or tables nested too deeply"),
        ("x = " + "1" * 5000, "rmpa.toml:1: the file: not TOML"),
    ],
)
def test_each_mistake_in_the_file_names_file_line_and_key(refuse: Refuse, text: str, message: str) -> None:
    assert refuse(text).startswith(message)


def test_a_flag_outweighs_realtime_of_the_variable_and_of_the_file(load: Load) -> None:
    text = "[realtime]\nenabled = true\npriority = 7"
    assert load(text).settings.realtime == RealtimeSettings(True, 7)
    assert load(text, environ={"RMPA_REALTIME": "0"}).settings.realtime == RealtimeSettings(False, 7)
    options = {"realtime": False}
    assert load(text, environ={"RMPA_REALTIME": "1"}, options=options).settings.realtime == RealtimeSettings(False, 7)


def test_file_mistake_is_reported_although_an_option_overrides_it(refuse: Refuse) -> None:
    assert refuse("domain = 999", options={"domain": "1"}).startswith("rmpa.toml:1: domain: 999")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"name": "robot-1"},
            (
                "--name: 'robot-1' is not a ROS base name (a letter, then letters, digits and _); "
                "did you mean --name robot_1?"
            ),
        ),
        (
            {"name": "x" * 65},
            f"--name: a peer's name has at most {core_limits.PEER_NAME_MAX} characters; did you mean",
        ),
        ({"port": "x"}, "--port: 'x' is not a whole number; a port (0: any) is between 0 and 65535"),
        ({"port": "-1"}, "--port: -1 is out of range"),
        ({"port": "1_0"}, "--port: '1_0' is not a whole number"),
        ({"port": "9" * 5000}, "--port: '999"),
        ({"seed": ("a", "a")}, "--seed: 'a' is there twice"),
        ({"seed": (":1",)}, "--seed: ':1' is not HOST:PORT"),
        ({"seed": ("a:0",)}, "--seed: 'a:0' is not HOST:PORT: 0 is out of range"),
        ({"seed": ("a b",)}, "--seed: 'a b' is not a host name"),
        ({"interface": ("wlan 0",)}, "--interface: 'wlan 0' is not the name of a network interface"),
        ({"multicast": "239.0.0.1:65500", "domain": "100"}, "--multicast: port 65500 plus domain 100 is beyond 6553"),
        ({"log_level": "loud"}, "--log-level: 'loud' is not a log level"),
        ({"config": "/no/such.toml"}, "--config: /no/such.toml: no such file"),
        ({"config": "/"}, "--config: /: is a directory"),
    ],
)
def test_each_mistake_in_a_flag_names_the_flag(refuse: Refuse, options: dict[str, object], message: str) -> None:
    assert refuse(options=options).startswith(message)


@pytest.mark.parametrize(
    ("environ", "message"),
    [
        ({"RMPA_LOG_JSON": "maybe"}, "RMPA_LOG_JSON: 'maybe' is neither true nor false"),
        (
            {"RMPA_NAME": "1"},
            "RMPA_NAME: '1' is not a ROS base name (a letter, then letters, digits and _); did you mean",
        ),
        ({"ROS_DOMAIN_ID": "x"}, "ROS_DOMAIN_ID: 'x' is not a whole number"),
        (
            {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNETS"},
            "ROS_AUTOMATIC_DISCOVERY_RANGE: 'SUBNETS' is not a range; did you",
        ),
        ({"ROS_STATIC_PEERS": "a:b"}, "ROS_STATIC_PEERS: 'a:b' is not HOST:PORT"),
        ({"RMPA_CONFIG": "/no/such.toml"}, "RMPA_CONFIG: /no/such.toml: no such file"),
    ],
)
def test_each_mistake_in_a_variable_names_the_variable(refuse: Refuse, environ: dict[str, str], message: str) -> None:
    assert refuse(environ=environ).startswith(message)


def test_a_file_that_is_not_utf_8_or_too_large(tmp_path: Path, refuse: Refuse) -> None:
    path = tmp_path / "rmpa.toml"
    path.write_bytes(b"name = 'a'\n# \xff\n")
    assert refuse() == "rmpa.toml:2: the file: not UTF-8 text; save it as UTF-8"
    path.write_bytes(b"#" * (limits.CONFIG_FILE_MAX + 1))
    assert "is it the right file?" in refuse()


def test_where_the_file_is_looked_for(tmp_path: Path) -> None:
    def place(name: str) -> Path:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        return path

    cwd = tmp_path / "work"
    environ = {"HOME": str(tmp_path / "home")}
    home = place("home/.config/rmpa/rmpa.toml")
    assert find_config_file(None, environ, cwd, []) == home
    xdg = place("xdg/rmpa/rmpa.toml")
    environ["XDG_CONFIG_HOME"] = str(tmp_path / "xdg")
    assert find_config_file(None, environ, cwd, []) == xdg
    local = place("work/rmpa.toml")
    assert find_config_file(None, environ, cwd, []) == local
    environ["RMPA_CONFIG"] = str(place("var.toml"))
    assert find_config_file(None, environ, cwd, []) == tmp_path / "var.toml"
    assert find_config_file(str(place("flag.toml")), environ, cwd, []) == tmp_path / "flag.toml"


def test_unreadable_directory_counts_as_empty_and_is_noted(
    load: Load, refuse: Refuse, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = Path.is_file

    def is_file(path: Path) -> bool:
        if "closed" in path.parts:
            raise PermissionError(EACCES, "Permission denied", str(path))
        return real(path)

    monkeypatch.setattr(Path, "is_file", is_file)
    home = tmp_path / "closed"
    loaded = load(environ={"HOME": str(home)})
    assert loaded.settings.config_file is None
    assert loaded.notes == (f"{home / '.config/rmpa/rmpa.toml'} is not looked for: Permission denied",)
    assert f"--config: {home}/rmpa.toml: Permission denied" in refuse(None, options={"config": f"{home}/rmpa.toml"})
    assert "~nobody_of_that_name/rmpa.toml: there is no such home" in refuse(
        None, environ={"RMPA_CONFIG": "~nobody_of_that_name/rmpa.toml"}
    )


def test_lines_are_found_wherever_a_statement_stands() -> None:
    text = '# c\n\n[core] # port = 1\nhost = """\nport = 3\n"""\n\n# port\nport = \\\n'.replace("\\", "5")
    assert line_of(text, ("core",)) == 3
    assert line_of(text, ("core", "host")) == 4
    assert line_of(text, ("core", "port")) == 9
    assert line_of(text, ("core", "prot")) is None
    assert line_of("core.port = 5", ("core", "port")) == 1


@given(st.lists(st.sampled_from(["a = 1", "", "# c", "b = [", "1,", "]", '"""', "[t]", "c = '''", "x.y = 2"])))
def test_a_line_that_is_found_is_where_the_key_begins(lines: list[str]) -> None:
    text = "\n".join(lines)
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return
    for key in table:
        line = line_of(text, (key,))
        assert line is not None
        assert lines[line - 1].startswith((key, f"[{key}]"))


def test_discovery_port_is_shifted_by_the_domain() -> None:
    assert Settings(domain=3).discovery_port == limits.MULTICAST_PORT + 3


def test_host_port_prints_as_written() -> None:
    assert [str(HostPort("a", 1)), str(HostPort("a"))] == ["a:1", "a"]


def test_limits_come_from_variables_too_and_are_positive(load: Load, refuse: Refuse) -> None:
    environ = {
        "RMPA_LIMIT_NODES": "5",
        "RMPA_LIMIT_TOPICS": "6",
        "RMPA_LIMIT_SERVICES": "7",
        "RMPA_LIMIT_PARAMS": "8",
    }
    assert load(environ=environ).settings.limits == LimitSettings(5, 6, 7, 8)
    assert refuse("[limits]\nnodes = 0").startswith(
        "rmpa.toml:2: limits.nodes: 0 is out of range; a limit is between 1"
    )
    assert "did you mean limits.nodes?" in refuse("[limits]\nnode = 1")


def test_too_many_followed_parameters_are_refused(load: Load, refuse: Refuse) -> None:
    rules = "".join(f'[[param]]\nkey = "/a{n}"\nfrom = "arm"\n' for n in range(3))
    assert "3 rules, more than limits.params = 2; raise that" in refuse(f"{rules}[limits]\nparams = 2\n")
    assert len(load(f"{rules}[limits]\nparams = 3\n").settings.params.follow) == 3
