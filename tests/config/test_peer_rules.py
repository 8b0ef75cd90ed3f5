from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from rmpa.config.peer_rules import PeerRule, PolicySettings

if TYPE_CHECKING:
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


def test_the_second_spelling_of_renamings_says_what_to_write(refuse: Refuse) -> None:
    says = refuse(PEER + "[[peer.remap]]\ndirection = 'in'\nfrom = '/a'\nto = '/b'")
    assert says.startswith('rmpa.toml:3: peer.remap: an unknown key; write remap_in = { "FROM" = "TO" } for')


def test_one_prefix_for_many_peers_is_doubtful(load: Load) -> None:
    [note] = load("[[peer]]\nname = 'r*'\nprefix = '/r'\n").notes
    assert ":3: peer.prefix: /r is one place for every peer that r* fits; /{peer} would keep them apart" in note
