from __future__ import annotations

import socket

import pytest

from rmpa.agent import agent as core_choice
from rmpa.config.settings import Settings
from rmpa.core.errors import ConfigError
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.core.external import ExternalCore

EVERYWHERE = "0.0.0.0"
HERE = "127.0.0.1"


@pytest.fixture(autouse=True)
def machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """One with an address of its own, and no variables of ROS."""
    for variable in ("ROS_IP", "ROS_HOSTNAME"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr(core_choice, "local_addresses", lambda: ["10.0.0.7", HERE])


def test_the_embedded_core_is_the_default() -> None:
    made = core_choice.make_core(Settings(name="a"))
    assert isinstance(made, RosCore)
    assert (made.node_host, made.node_address) == (HERE, HERE)


@pytest.mark.parametrize(
    ("master", "environ", "listens", "told"),
    [
        ("", {}, HERE, HERE),
        ("http://localhost:11311/", {}, HERE, HERE),
        ("http://10.0.0.9:11311/", {}, EVERYWHERE, "10.0.0.7"),
        ("http://OURS:11311/", {}, EVERYWHERE, "OURS"),
        ("http://localhost:11311/", {"ROS_IP": "10.0.0.7"}, EVERYWHERE, "10.0.0.7"),
        ("http://10.0.0.9:11311/", {"ROS_HOSTNAME": "robot", "ROS_IP": "10.0.0.7"}, EVERYWHERE, "robot"),
        ("http://10.0.0.9:11311/", {"ROS_IP": HERE}, HERE, HERE),
    ],
)
def test_proxies_are_where_other_nodes_of_that_graph_would_be(
    monkeypatch: pytest.MonkeyPatch, master: str, environ: dict[str, str], listens: str, told: str
) -> None:
    for name, value in environ.items():
        monkeypatch.setenv(name, value)
    ours = socket.gethostname()
    made = core_choice.make_core(Settings(name="a", core_mode="external", core_master=master.replace("OURS", ours)))
    assert isinstance(made, ExternalCore)
    assert made.uri == (master.replace("OURS", ours) or "http://localhost:11311")
    assert (made.node_host, made.node_address) == (listens, told.replace("OURS", ours))


def test_a_variable_that_cannot_be_used_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_IP", "http://10.0.0.7")
    with pytest.raises(ConfigError, match="ROS_IP"):
        core_choice.make_core(Settings(name="a", core_mode="external"))
