from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.bridge.policy import Names, PeerNames
from rmpa.config.peer_rules import PeerRule
from rmpa.core.identity import Guid, Identity, proxied_node, proxy_name, proxy_prefix

ROBOT = PeerRule(
    "robot*",
    "/{peer}",
    (
        ("/scan", "/laser"), ("/tf", "/tf"), ("/arm/gripper", "/hand"), ("/arm/**", "/{peer}/left/**"),
    ),
    (("/goals/{peer}", "/goal"), ("/shared/**", "/**")),
)  # fmt: skip
NAMES = st.from_regex(r"(/[a-c]{1,2}){1,4}", fullmatch=True)


@pytest.mark.parametrize(
    ("wire", "local"),
    [
        ("/odom", "/robot1/odom"), ("/tf", "/tf"), ("/tf_static", "/robot1/tf_static"), ("/arm/gripper", "/hand"),
        ("/arm/gripper/state", "/robot1/left/gripper/state"), ("/arm", "/robot1/left"), ("/army", "/robot1/army"),
        ("/scan", "/laser"),
    ],
)  # fmt: skip
def test_their_names_here(wire: str, local: str) -> None:
    assert Names((ROBOT,)).of("robot1").local_name(wire) == local


@pytest.mark.parametrize(
    ("local", "wire"),
    [
        ("/robot1/cmd_vel", "/cmd_vel"), ("/robot1", "/robot1"), ("/robot12/cmd_vel", "/robot12/cmd_vel"),
        ("/map", "/map"), ("/goals/robot1", "/goal"), ("/goals/robot2", "/goals/robot2"),
        ("/shared/a/b", "/a/b"), ("/shared", "/shared"),
    ],
)  # fmt: skip
def test_our_names_there(local: str, wire: str) -> None:
    assert Names((ROBOT,)).of("robot1").wire_name(local) == wire


def test_a_name_is_renamed_once() -> None:
    names = PeerNames("p", (PeerRule("p", "", (("/a", "/b"), ("/b", "/c"))),))
    assert (names.local_name("/a"), names.local_name("/b"), names.local_name("/c")) == ("/b", "/c", "/c")
    assert (names.wires_of("/b"), names.wires_of("/a")) == (("/a",), ())
    swapped = PeerNames("p", (PeerRule("p", "", (("/a", "/b"), ("/b", "/a"))),))
    assert (swapped.local_name("/a"), swapped.local_name("/b")) == ("/b", "/a")


def test_without_rules_for_it_a_peer_is_plain() -> None:
    names = Names((ROBOT, PeerRule("base")))
    here = [names.of(peer).local_name("/a") for peer in ("base", "nobody", "robot2")]
    assert here == ["/a", "/a", "/robot2/a"]


@given(NAMES)
def test_a_prefix_leads_there_and_back(name: str) -> None:
    names = PeerNames("r", (PeerRule("r", "/{peer}"),))
    assert names.wire_name(names.local_name(name)) == name
    assert names.local_name(name) == "/r" + name


BASE = Identity(Guid.of("10.0.0.1", 40001), bytes(16), "base")


def test_a_proxy_tells_whom_it_stands_for() -> None:
    prefix = proxy_prefix(BASE, ())
    assert prefix == "/rmpa/base"
    assert proxy_name(prefix, "/ns/driver") == "/rmpa/base/ns/driver"
    assert proxied_node("/rmpa/base/ns/driver") == ("base", "/ns/driver")


def test_two_peers_of_one_name_have_proxies_apart() -> None:
    prefix = proxy_prefix(BASE, {"/rmpa/base"})
    assert prefix == "/rmpa/base_10_0_0_1_40001"
    assert proxied_node(proxy_name(prefix, "/driver")) == ("base_10_0_0_1_40001", "/driver")


@pytest.mark.parametrize("name", ["/driver", "/rmpa", "/rmpa/base", "/rmpanel/base/driver"])
def test_a_node_of_this_module_stands_for_itself(name: str) -> None:
    assert proxied_node(name) is None
