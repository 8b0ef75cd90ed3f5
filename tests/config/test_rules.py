"""Lists of tables in the settings: rules for peers, services, parameters, gateways."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from rmpa.config import limits
from rmpa.config.peer_rules import PeerRule, PolicySettings, ServiceRule
from rmpa.config.rules import Crossing, CrossingRule, FollowRule, GatewaySettings, Ros2Settings, overlap, untouchable
from rmpa.config.settings import ParamSettings, ServiceSettings, TimeSettings
from rmpa.core.contract import Transport
from tests.config.conftest import Load, Refuse

ROOT = Path(__file__).parents[2]


def test_everything_that_a_peer_may_have(load: Load) -> None:
    loaded = load(
        """
        [[peer]]
        name = "robot*"
        prefix = "/{peer}"
        remap_in = { "/tf" = "/tf", "/arm/**" = "/left/**" }
        remap_out = { "/map_{peer}" = "/map" }
        allow = ["/{pose,scan}".replace] # a comment
        """.replace('["/{pose,scan}".replace]', '["/**/cmd_vel", "/left/**"]')
        + """
        deny_types = ["sensor_msgs/Image"]
        """
    )
    assert loaded.settings.peers == (
        PeerRule(
            "robot*",
            "/{peer}",
            (("/tf", "/tf"), ("/arm/**", "/left/**")),
            (("/map_{peer}", "/map"),),
            PolicySettings(allow=("/**/cmd_vel", "/left/**"), deny_types=("sensor_msgs/Image",)),
        ),
    )
    assert loaded.notes == ()


PEER = '[[peer]]\nname = "r"\n'


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[[peer]]\nprefix = '/r'", ':1: peer: a rule without name; name = "robot*" makes it'),
        (PEER + "\n\nprefix = 'r'", ":5: peer.prefix: 'r' is not a namespace; did you mean \"/r\"?"),
        (PEER + "prefix = '/'", ":3: peer.prefix: '/' puts nothing in front"),
        (PEER + "prefix = '/rmpa/r'", ":3: peer.prefix: /rmpa/r never crosses"),
        (PEER + "remap_in = {'/a b' = '/c'}", "'/a b' is not a ROS name"),
        (PEER + "[peer.remap_in]\n'/a' = '/x'\n'/b' = '/c//d'", ":5: peer.remap_in./b: '/c//d' is not a ROS name"),
        (PEER + "[peer.remap_in]\n'/a' = '/x'\n'/b' = '/clock'", ":5: peer.remap_in./b: /clock never crosses"),
        (PEER + "remap_out = {'/rosout' = '/log'}", ":3: peer.remap_out./rosout: /rosout never crosses"),
        (PEER + "remap_out = {'/a' = '/rmpa/**'}", "/rmpa never crosses"),
        (PEER + "remap_in = {'/a/**' = '/b'}", "both end with /**"),
        (PEER + "remap_in = {'/a/*/b' = '/b'}", "'/a/*/b' is not a name"),
        (PEER + "remap_in = {'a' = '/b'}", 'did you mean "/a"?'),
        (PEER + "prefx = '/r'", "did you mean peer.prefix?"),
        (PEER + "remap_in = '/a'", "peer.remap_in: '/a' is not a table"),
        ("[peer]\nname = 'r'", "write [[peer]], in two brackets"),
        ("[[peer]]\nname = '/r'", "'/r' is not a glob over peers' names"),
        (PEER + "deny = ['x']", ":3: peer.deny: 'x' matches no topic: topics begin with /; did you mean \"/x\"?"),
    ],
)
def test_what_cannot_be_meant_is_refused_with_its_line(refuse: Refuse, text: str, says: str) -> None:
    assert says in refuse(text)


def test_the_documentation_s_examples_load(load: Load) -> None:
    blocks = re.findall(r"```toml\n(.*?)```", (ROOT / "docs" / "guides" / "names.md").read_text(), re.DOTALL)
    assert [load(block).notes for block in blocks] == [()] * 5


def test_names_that_become_one_or_each_other_s_are_taken(load: Load) -> None:
    """What comes of them shows at run time (tests/bridge/test_rules.py)."""
    assert load(f"{PEER}remap_in = {{'/a' = '/c', '/b' = '/c', '/x' = '/y', '/y' = '/x'}}").notes == ()


def test_one_prefix_for_many_peers_is_doubtful(load: Load) -> None:
    [note] = load("[[peer]]\nname = 'r*'\nprefix = '/r'\n").notes
    assert ":3: peer.prefix: /r is one place for every peer that r* fits; /{peer} would keep them apart" in note


def test_defaults_let_all_but_loggers_cross_for_a_minute(load: Load) -> None:
    assert load("").settings.services == ServiceSettings(("/**",), (), False, 60.0, Transport.RELAY, ())


def test_a_file_says_it_all(load: Load) -> None:
    text = """
        [services]
        allow = ["/arm/**"]
        deny = ["/**/restart"]
        loggers = true
        timeout = "500 ms"
        transport = "auto"
        [[service]]
        names = ["/plan/**", "/map"]
        timeout = "5 min"
        [[service]]
        names = ["/ik"]
        transport = "direct"
        [[service]]
        names = ["/**"]
        timeout = 2
        transport = "relay"
    """
    rules = (
        ServiceRule(("/plan/**", "/map"), 300.0),
        ServiceRule(("/ik",), None, Transport.DIRECT),
        ServiceRule(("/**",), 2.0, Transport.RELAY),
    )
    assert load(text).settings.services == ServiceSettings(
        ("/arm/**",), ("/**/restart",), True, 0.5, Transport.AUTO, rules
    )


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("[services]\nallow = ['/a//b']", 2, "services.allow: '/a//b' matches no service"),
        ("[services]\nallow = ['arm']", 2, 'did you mean "/arm"?'),
        ("[services]\ntimeout = 'infinite'", 2, "too long for a call"),
        ("[services]\ntimeout = 4000", 2, "at most 3600 s"),
        ("[services]\ntimeout = '10 Hz'", 2, "is a rate"),
        ("[services]\ntimeouts = 1", 2, "did you mean services.timeout?"),
        ("[services]\nloggers = 1", 2, "is not true or false"),
        ("[[service]]\nnames = ['/a']", 1, "a rule without timeout and transport; one has names"),
        ("[[service]]\ntimeout = 1", 1, "a rule without names"),
        ("[[service]]\ntransport = 'auto'", 1, "a rule without names"),
        ("[[service]]\nnames = ['/a']\ntransport = 'diret'", 3, 'one of relay, direct, auto; did you mean "direct"?'),
        ("[services]\ntransport = 1", 2, "services.transport: 1 is not a text in quotes"),
        ("\n[[service]]\nnames = []\ntimeout = 1", 3, "an empty list fits nothing"),
        ("[[service]]\nnames = ['/a', 'b c']\ntimeout = 1", 2, "'b c' is not a glob over services"),
        ("[[service]]\nnames = ['/a']\ntimeout = 0", 3, "service.timeout: 0 is out of range"),
        ("[service]\nnames = ['/a']", 1, "write [[service]]"),
        ("[[service]]\nname = ['/a']\ntimeout = 1", 2, "did you mean service.names?"),
    ],
)
def test_what_cannot_be_is_named_with_its_line(refuse: Refuse, text: str, line: int, words: str) -> None:
    said = refuse(text)
    assert (said.startswith(f"rmpa.toml:{line}: "), words in said) == (True, True), said


def test_all_of_it(load: Load) -> None:
    settings = load(
        """
[params]
remote_get = ["/open/**"]
remote_set = []
[time]
follow = "simulator"
share = true
[[param]]
key = "/robot_description"
from = "base"
to = "/base/robot_description"
[[param]]
key = "/arm/"
from = "arm"
""",
        host_name="pad",
    ).settings
    rules = (FollowRule("/robot_description", "base", "/base/robot_description"), FollowRule("/arm", "arm", "/arm"))
    assert settings.params == ParamSettings(("/open/**",), (), rules)
    assert settings.time == TimeSettings("simulator", share=True)
    assert list(map(str, rules)) == ["base:/robot_description as /base/robot_description", "arm:/arm"]


BASE = '[[param]]\nkey = "/a"\nfrom = "base"\n'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[[param]]\nkey = "/a"', "1: param: a rule without from"),
        ('[[param]]\nfrom = "base"', "1: param: a rule without key"),
        (BASE + 'too = "/b"', "4: param.too: an unknown key; did you mean param.to?"),
        (BASE.replace("/a", "a"), "2: param.key: 'a' is not a global name; did you mean \"/a\"?"),
        (BASE.replace("/a", "/a/*"), "2: param.key: '/a/*' is a glob"),
        (BASE.replace("/a", "/"), "2: param.key: the root holds every parameter"),
        (BASE.replace("/a", "/a b"), "2: param.key: '/a b' is not a parameter's name"),
        (BASE.replace("/a", "/" + "a" * 2000), "2: param.key: a name of 2001 characters"),
        (BASE.replace("base", "robot-1"), "3: param.from: 'robot-1' is not a ROS base name"),
        (BASE.replace("base", "hall/arm"), "3: param.from: 'hall/arm' is a module of another site"),
        (BASE.replace("base", "pad"), "3: param.from: pad is this module itself"),
        (BASE + 'to = "/run_id"', "4: param.to: /run_id cannot be followed: it names the run"),
        (BASE + 'to = "/roslaunch"', "4: param.to: /roslaunch cannot be followed"),
        (BASE.replace("/a", "/use_sim_time"), "2: param.key: /use_sim_time cannot be followed: time is"),
        (BASE + BASE, "4: param: /a cannot come from base too: /a comes from base's /a already; a parameter has one"),
        (
            BASE + BASE.replace("base", "arm").replace("/a", "/a/b"),
            "4: param: /a/b cannot come from arm too: /a comes",
        ),
        (BASE.replace("/a", "/a/b") + BASE + 'to = "/a"', "4: param: /a cannot come from base too: /a/b comes from"),
        ('[param]\nkey = "/a"', "1: param: one table, where a list of them is expected; write [[param]]"),
        (
            "[params]\nremote_get = ['a b']",
            "2: params.remote_get: 'a b' is not a glob over parameters; a parameter has",
        ),
        ("[params]\nremote_get = ['a']", "2: params.remote_get: 'a' matches no parameter"),
        ("[params]\nget = []", "2: params.get: an unknown key"),
        ("[time]\nfollow = 'pad'", "2: time.follow: pad is this module itself"),
        ("[time]\nfollow = 'a b'", "2: time.follow: 'a b' is not a ROS base name"),
        ("[time]\nshare = 'x'", "2: time.share: "),
    ],
)
def test_a_mistake_is_told_with_its_line(refuse: Refuse, text: str, message: str) -> None:
    assert refuse(text, host_name="pad").removeprefix("rmpa.toml:").startswith(message)


def test_too_many_rules(refuse: Refuse) -> None:
    rules = "".join(BASE.replace("/a", f"/a{n}") for n in range(limits.FOLLOWED_MAX + 1))
    assert f"{limits.FOLLOWED_MAX + 1} rules" in refuse(rules)


def test_names_that_touch_each_other() -> None:
    assert overlap("/a", "/a")
    assert overlap("/a/", "/a/b")
    assert overlap("/a/b/c", "/a")
    assert overlap("/", "/a")
    assert not overlap("/a", "/ab")
    for key in ("/run_id", "/roslaunch", "/roslaunch/uris/x", "/use_sim_time", "/use_sim_time/", "/rosdistro", "/"):
        assert untouchable(key), key
    assert not untouchable("/run_ids")


def test_without_a_table_nothing_is_joined(load: Load) -> None:
    assert load("").settings.gateway == GatewaySettings()
    assert GatewaySettings().site == ""
    assert not Ros2Settings().enabled


def test_a_gateways_file_says_it_all(load: Load) -> None:
    text = """
        [gateway]
        site = "warehouse"
        rank = 5
        connect = ["tls/fleet.example:7447", "tcp/[fe80::1%eth0]:7447"]
        listen = ["tcp/0.0.0.0:7448#iface=eth0"]
        router = true
        insecure = true
        uplink = "1 Mbit/s"
        [gateway.ros2]
        enabled = true
        domain = 4
        distribution = "humble"
        mapping = ["a.yaml", "b.yaml"]
        [[gateway.rule]]
        names = ["/camera/**"]
        sites = ["ros2", "hall*"]
        modules = ["arm"]
        crossing = "out"
        rate = "2 Hz"
        size = "1 Mbit/s"
        [[gateway.rule]]
        name = "/{site}/{module}{name}"
        [[gateway.rule]]
        names = ["/map"]
        crossing = "in"
        name = "/their_map"
    """
    assert load(text).settings.gateway == GatewaySettings(
        "warehouse",
        5,
        ("tls/fleet.example:7447", "tcp/[fe80::1%eth0]:7447"),
        ("tcp/0.0.0.0:7448#iface=eth0",),
        True,
        True,
        125_000,
        Ros2Settings(True, 4, "humble", ("a.yaml", "b.yaml")),
        (
            CrossingRule(("/camera/**",), ("ros2", "hall*"), ("arm",), Crossing.OUT, "{name}", 2.0, 125_000),
            CrossingRule(name="/{site}/{module}{name}"),
            CrossingRule(("/map",), crossing=Crossing.IN, name="/their_map"),
        ),
    )


@pytest.mark.parametrize(
    ("size", "expected"),
    [('"100 KB/s"', 100_000), ('"64 KiB"', 65_536), ('"1.5 Mbit/s"', 187_500), ("5000", 5000), ('"unlimited"', None)],
)
def test_a_size_has_the_units_of_files_and_of_links(load: Load, size: str, expected: int | None) -> None:
    assert load(f"[[gateway.rule]]\nsize = {size}\n").settings.gateway.rules == (CrossingRule(size=expected),)


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("[gateway]\nsite = 'hall-2'", 2, "gateway.site: 'hall-2' is not a ROS base name"),
        ("[gateway]\nsite = 'hall-2'", 2, 'did you mean "hall_2"?'),
        ("[gateway]\nsite = 'ros2'", 2, "ros2 is reserved"),
        (f"[gateway]\nsite = '{'a' * 64}'", 2, "a site's name has at most 63 characters"),
        ("[gateway]\nrank = 1000", 2, "a rank is between 0 and 999"),
        ("[gateway]\nconnect = ['fleet.example:7447']", 2, 'did you mean "tls/fleet.example:7447"?'),
        ("[gateway]\nconnect = ['tls/fleet.example']", 2, 'did you mean "tls/fleet.example:7447"?'),
        ("[gateway]\nconnect = ['tcp://fleet.example:7447/']", 2, 'did you mean "tcp/fleet.example:7447"?'),
        ("[gateway]\nconnect = ['tsl/a:7447']", 2, 'there are tls, tcp, quic, udp, ws; did you mean "tls/a:7447"?'),
        ("[gateway]\nlisten = ['tcp/a:70000']", 2, "no port between 1 and 65535"),
        ("[gateway]\nlisten = ['tcp/a:1', 'tcp/a b:1']", 2, "is not an endpoint of Zenoh"),
        ("[gateway]\nconnect = 'tcp/a:1'", 2, 'did you mean ["tcp/a:1"]?'),
        ("[gateway]\nsites = 'a'", 2, "did you mean gateway.site?"),
        ("[gateway]\nenabled = true", 2, "unknown key"),
        ("[gateway]\nros2 = true", 2, "gateway.ros2: true is not a table"),
        ("[gateway]\nrule = 1", 2, "gateway.rule: 1 is not a list"),
        ("[gateway.ros2]\n\ndistribution = 'jazy'", 3, 'did you mean "jazzy"?'),
        ("[gateway.ros2]\ndomains = 1", 2, "did you mean gateway.ros2.domain?"),
        ("[gateway.ros2]\ndomain = 233", 2, "a domain id is between 0 and 232"),
        ("[gateway.ros]\ndomain = 1", 1, "gateway.ros: an unknown table; did you mean gateway.ros2?"),
        ("[gateway.rule]\nrate = 1", 1, "write [[gateway.rule]]"),
        ("[[gateway.rules]]\nrate = 1", 1, "did you mean gateway.rule?"),
        ("[[gateway.rule]]\nrates = 1", 2, "did you mean gateway.rule.rate?"),
        ("[[gateway.rule]]\nnames = ['/a']", 1, "a rule that selects nothing"),
        ("[[gateway.rule]]\nrate = 1\n[[gateway.rule]]\nrate = 0", 4, "gateway.rule.rate: 0 is out of range"),
        ("[[gateway.rule]]\nnames = ['a']\nrate = 1", 2, 'did you mean "/a"?'),
        ("[[gateway.rule]]\nsites = []\nrate = 1", 2, "leave sites out, or name some"),
        ("[[gateway.rule]]\nmodules = ['a/b']\nrate = 1", 2, "'a/b' is not a glob over peers' names"),
        ("[[gateway.rule]]\ncrossing = 'outt'", 2, 'both, out, in, none; did you mean "out"?'),
        ("[[gateway.rule]]\ncrossing = 'in'\nrate = 1", 3, "rate is about what goes out"),
        ("[[gateway.rule]]\ncrossing = 'none'\nsize = 1", 3, "leave size out"),
        ("[[gateway.rule]]\ncrossing = 'out'\nname = '/a{name}'", 3, "name is about what comes in"),
        ("[[gateway.rule]]\nname = '/all'", 2, "all that the rule selects would get one name"),
        ("[[gateway.rule]]\nname = '/{sites}{name}'", 2, "'{sites}' stands for nothing; there are {site}"),
        ("[[gateway.rule]]\nname = '{site}{name}'", 2, 'did you mean "/{site}{name}"?'),
        ("[[gateway.rule]]\nname = '/{site}/{name}'", 2, "{name} begins with a slash"),
        ("[[gateway.rule]]\nsize = '5 parsec'", 2, 'a text such as "100 KB/s" or "1 Mbit/s"'),
        ("[[gateway.rule]]\nsize = 0", 2, "out of range"),
    ],
)
def test_what_no_rule_of_a_gateway_can_be_is_named_with_its_line(
    refuse: Refuse, text: str, line: int, words: str
) -> None:
    said = refuse(text)
    assert (said.startswith(f"rmpa.toml:{line}: "), words in said) == (True, True), said
