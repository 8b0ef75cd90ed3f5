"""``[gateway]``, ``[gateway.ros2]`` and ``[[gateway.rule]]``: what they may say, and the errors for anything else."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from rmpa.config.rules import Crossing, CrossingRule, GatewaySettings, Ros2Settings

if TYPE_CHECKING:
    from tests.config.conftest import Load, Refuse


def test_without_a_table_nothing_is_joined(load: Load) -> None:
    assert load("").settings.gateway == GatewaySettings()
    assert GatewaySettings().site == ""
    assert not Ros2Settings().enabled


def test_a_file_says_it_all(load: Load) -> None:
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
        ("[gateway]\nstore = 'last.db'", 2, "an unknown key; no gateway keeps values"),
        ("[[gateway.rule]]\nrate = 1\nkeep = true", 3, "gateway.rule.keep: an unknown key; no gateway keeps values"),
        ("[gateway]\nros1_bridge = true", 2, "an unknown key; let a gateway with a site name join those robots"),
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
def test_what_cannot_be_is_named_with_its_line(refuse: Refuse, text: str, line: int, words: str) -> None:
    said = refuse(text)
    assert (said.startswith(f"rmpa.toml:{line}: "), words in said) == (True, True), said
