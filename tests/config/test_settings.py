"""Settings: every source, their order, and what each mistake is told."""

from __future__ import annotations

import json
import tomllib
from errno import EACCES
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.config import limits
from rmpa.config.read import find_config_file, parse_config
from rmpa.config.rules import GatewaySettings
from rmpa.config.settings import SETTINGS, RealtimeSettings, Settings, TrustSettings, json_value
from rmpa.config.toml_file import line_of
from rmpa.config.values import HostPort, Multicast, did_you_mean
from rmpa.core import limits as core_limits
from rmpa.core.contract import Transport
from rmpa.core.errors import ConfigError
from tests.config.conftest import Load, Refuse
from tests.core.example import EXAMPLE, uncommented


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


SOURCES: tuple[tuple[Any, ...], ...] = (
    # The key of the file, the attribute of the settings, the variable, the option, the value; how it is written.
    ("name", "name", "RMPA_NAME", "name", "a"),
    ("domain", "domain", "RMPA_DOMAIN", "domain", 3),
    ("state_dir", "state_dir", "RMPA_STATE_DIR", "", "/var/x"),
    ("", "runtime_dir", "RMPA_RUNTIME_DIR", "", "/run/x"),
    ("core.keep", "core_keep", "RMPA_KEEP", "keep", "never"),
    ("core.host", "core_host", "RMPA_CORE_HOST", "core_host", "localhost"),
    ("core.port", "core_port", "RMPA_CORE_PORT", "core_port", 1),
    ("mesh.port", "port", "RMPA_PORT", "port", 2),
    ("discovery.interfaces", "interfaces", "RMPA_INTERFACES", "interface", ("lo", "eth0")),
    ("discovery.seeds", "seeds", "RMPA_SEEDS", "seed", (HostPort("h", 1), HostPort("10.0.0.1"))),
    ("discovery.multicast", "multicast", "RMPA_MULTICAST", "multicast", Multicast(True, "239.1.2.3", 5000)),
    ("discovery.multicast", "multicast", "RMPA_MULTICAST", "multicast", Multicast(False)),
    ("bridge.allow", "policy.allow", "RMPA_ALLOW", "", ("/a", "/b/**")),
    ("bridge.deny", "policy.deny", "RMPA_DENY", "", ("/c",)),
    ("bridge.allow_types", "policy.allow_types", "RMPA_ALLOW_TYPES", "", ("std_msgs/*",)),
    ("bridge.deny_types", "policy.deny_types", "RMPA_DENY_TYPES", "", ("std_msgs/Header",)),
    ("bridge.transport", "transport", "RMPA_TRANSPORT", "", Transport.AUTO),
    ("bridge.prefix_peers", "prefix_peers", "RMPA_PREFIX_PEERS", "prefix_peers", True),
    ("bridge.rosout", "rosout", "RMPA_ROSOUT", "", True),
    ("services.allow", "services.allow", "RMPA_SERVICE_ALLOW", "", ("/arm/**",)),
    ("services.deny", "services.deny", "RMPA_SERVICE_DENY", "", ("/a", "/b")),
    ("services.loggers", "services.loggers", "RMPA_SERVICE_LOGGERS", "", True),
    ("services.timeout", "services.timeout", "RMPA_SERVICE_TIMEOUT", "", 4.0, "4 s"),
    ("services.transport", "services.transport", "RMPA_SERVICE_TRANSPORT", "", Transport.DIRECT),
    ("nodes.kill", "nodes.kill", "RMPA_NODE_KILL", "", ("/a/**",)),
    ("resources.folder", "resources.folder", "RMPA_RESOURCE_FOLDER", "", "/r"),
    ("resources.start", "resources.start", "RMPA_RESOURCE_START", "", False),
    ("resources.open", "resources.open", "RMPA_RESOURCE_OPEN", "", True),
    ("params.remote_get", "params.remote_get", "RMPA_REMOTE_GET", "", ("/a", "/b")),
    ("params.remote_set", "params.remote_set", "RMPA_REMOTE_SET", "", ("/c",)),
    ("time.follow", "time.follow", "RMPA_TIME_FOLLOW", "", "sim"),
    ("time.share", "time.share", "RMPA_TIME_SHARE", "", True),
    ("limits.nodes", "limits.nodes", "RMPA_LIMIT_NODES", "", 5),
    ("limits.topics", "limits.topics", "RMPA_LIMIT_TOPICS", "", 6),
    ("limits.services", "limits.services", "RMPA_LIMIT_SERVICES", "", 7),
    ("limits.params", "limits.params", "RMPA_LIMIT_PARAMS", "", 8),
    ("lanes.express_dscp", "lanes.express_dscp", "RMPA_EXPRESS_DSCP", "", 46),
    ("lanes.express_priority", "lanes.express_priority", "RMPA_EXPRESS_PRIORITY", "", 5),
    ("lanes.bulk_dscp", "lanes.bulk_dscp", "RMPA_BULK_DSCP", "", 8),
    ("lanes.bulk_priority", "lanes.bulk_priority", "RMPA_BULK_PRIORITY", "", 1),
    ("realtime.enabled", "realtime.enabled", "RMPA_REALTIME", "realtime", True),
    ("realtime.priority", "realtime.priority", "RMPA_REALTIME_PRIORITY", "", 80),
    ("realtime.lock_memory", "realtime.lock_memory", "RMPA_REALTIME_LOCK_MEMORY", "", False),
    ("web.enabled", "web.enabled", "RMPA_WEB", "web", True),
    ("web.port", "web.port", "RMPA_WEB_PORT", "", 9000),
    ("web.listen", "web.listen", "RMPA_WEB_LISTEN", "", "0.0.0.0"),
    ("web.token_file", "web.token_file", "RMPA_WEB_TOKEN_FILE", "", "/t"),
    ("web.hosts", "web.hosts", "RMPA_WEB_HOSTS", "", ("a", "b")),
    ("web.ports", "web.ports", "RMPA_WEB_PORTS", "", (1, 2)),
    ("web.origins", "web.origins", "RMPA_WEB_ORIGINS", "", ("https://a.example",)),
    ("web.control", "web.control", "RMPA_WEB_CONTROL", "", True),
    ("web.cert", "web.cert", "RMPA_WEB_CERT", "", "/c"),
    ("web.key", "web.key", "RMPA_WEB_KEY", "", "/k"),
    ("web.drive", "web.drive", "RMPA_WEB_DRIVE", "", True),
    ("web.command_age_ms", "web.command_age_ms", "RMPA_WEB_COMMAND_AGE_MS", "", 200),
    ("record.enabled", "record.enabled", "RMPA_RECORD", "record", True),
    ("record.topics", "record.topics", "RMPA_RECORD_TOPICS", "", ("/a", "/b")),
    ("record.deny", "record.deny", "RMPA_RECORD_DENY", "", ("/a", "/b")),
    ("record.seconds", "record.seconds", "RMPA_RECORD_SECONDS", "", 30.0, "30 s"),
    ("record.megabytes", "record.megabytes", "RMPA_RECORD_MEGABYTES", "", 64),
    ("record.kept_megabytes", "record.kept_megabytes", "RMPA_RECORD_KEPT_MEGABYTES", "", 64),
    ("record.topic_rate", "record.topic_rate", "RMPA_RECORD_TOPIC_RATE", "", 1000, "1 kB/s"),
    ("record.total_rate", "record.total_rate", "RMPA_RECORD_TOTAL_RATE", "", 1000, "1 kB/s"),
    ("record.thin", "record.thin", "RMPA_RECORD_THIN", "", 2.0, "2 Hz"),
    ("record.thin_types", "record.thin_types", "RMPA_RECORD_THIN_TYPES", "", ("a/*", "b/*")),
    ("record.keep_on", "record.keep_on", "RMPA_RECORD_KEEP_ON", "", ("alarm", "contract")),
    ("record.stop_topics", "record.stop_topics", "RMPA_RECORD_STOP_TOPICS", "", ("/a", "/b")),
    ("record.after", "record.after", "RMPA_RECORD_AFTER", "", 2.0, "2 s"),
    ("record.fsync", "record.fsync", "RMPA_RECORD_FSYNC", "", 0.5, "500 ms"),
    ("trust.default", "trust.default", "RMPA_TRUST_DEFAULT", "", "allow"),
    ("trust.relays", "trust.relays", "RMPA_TRUST_RELAYS", "", ("gate",)),
    ("trust.direct", "trust.direct", "RMPA_TRUST_DIRECT", "", True),
    ("trust.require", "trust.require", "RMPA_TRUST_REQUIRE", "", True),
    ("trust.insecure", "trust.insecure", "RMPA_TRUST_INSECURE", "", True),
    ("gateway.site", "gateway.site", "RMPA_SITE", "site", "warehouse"),
    ("gateway.rank", "gateway.rank", "RMPA_GATEWAY_RANK", "rank", 7),
    (
        "gateway.connect",
        "gateway.connect",
        "RMPA_GATEWAY_CONNECT",
        "connect",
        ("tls/fleet.example:7447", "tcp/[::1]:1"),
    ),
    ("gateway.listen", "gateway.listen", "RMPA_GATEWAY_LISTEN", "listen", ("tcp/0.0.0.0:7447",)),
    ("gateway.router", "gateway.router", "RMPA_GATEWAY_ROUTER", "router", True),
    ("gateway.insecure", "gateway.insecure", "RMPA_GATEWAY_INSECURE", "", True),
    ("gateway.uplink", "gateway.uplink", "RMPA_GATEWAY_UPLINK", "uplink", 125_000, "1 Mbit/s"),
    ("gateway.ros2.enabled", "gateway.ros2.enabled", "RMPA_ROS2", "ros2", True),
    ("gateway.ros2.domain", "gateway.ros2.domain", "RMPA_ROS2_DOMAIN", "ros2_domain", 3),
    (
        "gateway.ros2.distribution",
        "gateway.ros2.distribution",
        "RMPA_ROS2_DISTRIBUTION",
        "ros2_distribution",
        "kilted",
    ),
    ("gateway.ros2.via", "gateway.ros2.via", "RMPA_ROS2_VIA", "ros2_via", "rclpy"),
    ("gateway.ros2.python", "gateway.ros2.python", "RMPA_ROS2_PYTHON", "ros2_python", "/opt/bin/python3"),
    ("gateway.ros2.mapping", "gateway.ros2.mapping", "RMPA_ROS2_MAPPING", "ros2_mapping", ("a.yaml", "b.yaml")),
    ("relay.enabled", "relay", "RMPA_RELAY", "", True),
    ("control.group", "control_group", "RMPA_CONTROL_GROUP", "", "robots"),
    ("log.level", "log_level", "RMPA_LOG_LEVEL", "log_level", "warning"),
    ("log.json", "log_json", "RMPA_LOG_JSON", "log_json", True),
)


@pytest.mark.parametrize(("key", "attribute", "variable", "option", "value", "text"), [(*r, "")[:6] for r in SOURCES])
def test_a_setting_comes_from_file_variable_or_option_and_changes_no_other(
    load: Load, key: str, attribute: str, variable: str, option: str, value: Any, text: str
) -> None:
    values = value if isinstance(value, tuple) else (value,)
    texts = [text or (("no", "yes")[each] if isinstance(each, bool) else str(each)) for each in values]
    table, _, name = key.rpartition(".")
    sources: list[dict[str, Any]] = [{"environ": {variable: ";".join(texts), "RMPA_AGENT": "other"}}]
    if key:  # what JSON writes TOML reads
        line = f"{name} = {json.dumps(text or json_value(value))}\n"
        sources.append({"text": f"{f'[{table}]' if table else ''}\n{line}"})
    if option:
        sources.append(
            {"options": {option: value if value is True else tuple(texts) if values is value else texts[0]}}
        )
    for source in sources:
        loaded = load(**{"text": ""} | source)
        changed = {s.name: s.value_in(loaded.settings) for s in SETTINGS}
        usual = {s.name: s.value_in(Settings(name="base")) for s in SETTINGS}
        assert {name: found for name, found in changed.items() if found != usual[name]} == {attribute: value}, source
        assert len(loaded.notes) == (attribute == "trust.insecure")  # which is said


def test_every_setting_is_tried_from_every_source() -> None:
    alone = [
        s for s in SETTINGS if not s.is_list_of_tables and s.name not in ("core_mode", "core_master", "trust.groups")
    ]
    for column, found in enumerate(
        ([".".join(s.key) for s in alone], [s.name for s in alone], [s.env for s in alone])
    ):
        assert {row[column] for row in SOURCES} == {*found}
    options = {s.option_name for s in alone if s.option} - {"insecure"}
    assert {row[3] for row in SOURCES} == {*options, ""}


def test_insecure_of_a_gateway_means_its_connections_and_its_start(load: Load) -> None:
    found = load(options={"insecure": True}).settings
    assert (found.trust, found.gateway) == (TrustSettings(insecure=True), GatewaySettings(insecure=True))


def test_external_core_is_ROS_MASTER_URI_unless_named(load: Load) -> None:  # noqa: N802
    environ = {"ROS_MASTER_URI": "http://robot:11312", "RMPA_CORE": "external"}
    loaded = load(environ=environ)
    assert loaded.settings == Settings(name="base", core_mode="external", core_master="http://robot:11312")
    assert loaded.notes == ()
    assert load(options={"core": "external", "master": "http://robot:11312"}).settings == loaded.settings
    assert load(environ={"RMPA_CORE": "external", "RMPA_MASTER": "http://robot:11312"}).settings == loaded.settings
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
    assert notes == ("--core-port: is of no use with an external core", "--keep: is of no use with an external core")


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
        # Ours, in other ways to write them than those of the table above.
        ({"RMPA_INTERFACES": "lo, eth0"}, Settings(name="base", interfaces=("lo", "eth0"))),
        ({"RMPA_MULTICAST": "239.0.0.1"}, Settings(name="base", multicast=Multicast(True, "239.0.0.1"))),
        (
            {"RMPA_REALTIME": "1", "RMPA_LOG_LEVEL": "WARNING"},
            Settings(name="base", realtime=RealtimeSettings(True), log_level="warning"),
        ),
    ],
)
def test_the_environment(load: Load, environ: dict[str, str], expected: Settings) -> None:
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
        ("domian = 3", "1: domian: an unknown key; did you mean domain?"),
        ("\n\n[coer]\nport = 1", "3: coer: an unknown table; did you mean core?"),
        ("[core]\n# a comment\nprot = 1", "3: core.prot: an unknown key; did you mean core.port?"),
        ('seeds = ["a"]', "1: seeds: an unknown key; seeds belongs in [discovery]"),
        ("[core]\ndomain = 1", "2: core.domain: an unknown key; domain belongs above the first table"),
        ("[log]\nxyzzy = 1", "2: log.xyzzy: an unknown key; known here: level, json"),
        ("[core]\n\nport = '1'", "3: core.port: '1' is not a whole number"),
        ("[log]\njson = 1", "2: log.json: 1 is not true or false"),
        ("core = 5", "1: core: 5 is not a table"),
        ("[core]\nport = 70000", "2: core.port: 70000 is out of range; a port is between 1 and 65535"),
        ("[core]\nport = 0", "2: core.port: 0 is out of range; a port is between 1 and 65535"),
        ("domain = 233", "1: domain: 233 is out of range; a domain id is between 0 and 232"),
        (
            'name = "robot-1"',
            (
                "1: name: 'robot-1' is not a ROS base name (a letter, then letters, digits and _); "
                'did you mean "robot_1"?'
            ),
        ),
        (
            '[discovery]\nseeds = [\n  "10.0.0.1",\n  # a comment\n  "10.0.0.300:1",\n]',
            (
                "5: discovery.seeds: '10.0.0.300:1' is not HOST:PORT: '10.0.0.300' is not an IPv4 address; "
                "one looks like 192.168.1.20"
            ),
        ),
        ('[discovery]\nseeds = ["a",\n1]', "3: discovery.seeds: 1 is not a text in quotes"),
        ('[discovery]\nseeds = ["a:1", "a:1"]', "2: discovery.seeds: 'a:1' is there twice; delete on"),
        ('[discovery]\nseeds = ["fe80::1"]', "2: discovery.seeds: 'fe80::1' is not HOST:PORT"),
        ('[discovery]\nmulticast = "10.0.0.1:5"', "2: discovery.multicast: 10.0.0.1 is not a multicast group"),
        ('[discovery]\nmulticast = "239.0.0.1:x"', "2: discovery.multicast: '239.0.0.1:x' is not GROUP:PORT"),
        ('[discovery]\nmulticast = "ff02::1"', "2: discovery.multicast: 'ff02' is not an IPv4 multicast group"),
        ("[discovery]\nmulticast = 5", "2: discovery.multicast: 5 is not true or false or a text in quotes"),
        ('[bridge]\nallow = ["cmd"]', "2: bridge.allow: 'cmd' matches no topic: topics begin with /; did you "),
        ('[bridge]\ndeny = ["/a b"]', "2: bridge.deny: '/a b' is not a glob over topics"),
        ('[bridge]\ndeny = ["/a//b"]', "2: bridge.deny: '/a//b' matches no topic: it has // in it"),
        (
            '[bridge]\nallow_types = ["Image"]',
            (
                "2: bridge.allow_types: 'Image' matches no message type: types have a package in front; "
                'did you mean "*/Image"?'
            ),
        ),
        ('[log]\nlevel = "wran"', "2: log.level: 'wran' is not a log level; the levels are debug, info, "),
        (
            "[lanes]\nexpress_priority = 7",
            "2: lanes.express_priority: 7 is out of range; SO_PRIORITY without CAP_NET_ADMIN is between 0",
        ),
        ("[lanes]\nbulk_dscp = 64", "2: lanes.bulk_dscp: 64 is out of range; a DSCP (the TOS byte / 4; CS6 is"),
        ("[lanes]\nexpres_dscp = 1", "2: lanes.expres_dscp: an unknown key; did you mean lanes.express_dscp?"),
        ("[realtime]\npriority = 0", "2: realtime.priority: 0 is out of range; a priority of SCHED_FIFO is be"),
        ('[bridge]\nallow = ["/a", "/a"]', "2: bridge.allow: '/a' is there twice; delete one of them"),
        ("[realtime]\nenable = true", "2: realtime.enable: an unknown key; did you mean realtime.enabled"),
        ('[bridge]\nallow = "/a"', "2: bridge.allow: '/a' is not a list; did you mean [\"/a\"]?"),
        ("name = robot", '1: the file: not TOML: Invalid value; texts need quotes: "robot"'),
        ("a = 1\na = 2", "2: the file: not TOML: Cannot overwrite a value"),
        ("name: robot", "1: the file: not TOML"),
        ("[core", "1: the file: not TOML: Expected ']'"),
        ("x = " + "[" * 5000, "1: the file: lists or tables nested too deeply"),
        ("x = " + "1" * 5000, "1: the file: not TOML"),
    ],
)
def test_each_mistake_in_the_file_names_file_line_and_key(refuse: Refuse, text: str, message: str) -> None:
    assert refuse(text).startswith(f"rmpa.toml:{message}")


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


def test_limits_are_positive(refuse: Refuse) -> None:
    assert refuse("[limits]\nnodes = 0").startswith(
        "rmpa.toml:2: limits.nodes: 0 is out of range; a limit is between 1"
    )
    assert "did you mean limits.nodes?" in refuse("[limits]\nnode = 1")


def test_too_many_followed_parameters_are_refused(load: Load, refuse: Refuse) -> None:
    rules = "".join(f'[[param]]\nkey = "/a{n}"\nfrom = "arm"\n' for n in range(3))
    assert "3 rules, more than limits.params = 2; raise that" in refuse(f"{rules}[limits]\nparams = 2\n")
    assert len(load(f"{rules}[limits]\nparams = 3\n").settings.params.follow) == 3


@pytest.mark.parametrize(
    ("word", "near"),
    [("/dead", None), ("/cmd", "/cmd_vel"), ("/chater", "/chatter"), ("/Cmd-Vel", "/cmd_vel"), ("/x", None)],
)
def test_a_name_is_offered_only_if_it_is_like_the_misspelt_one(word: str, near: str | None) -> None:
    assert did_you_mean(word, ["/chatter", "/cmd_vel", "/denied2"]) == near
