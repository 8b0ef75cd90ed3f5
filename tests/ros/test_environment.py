from __future__ import annotations

import pytest

from rmpa.core.errors import ConfigError
from rmpa.ros.environment import RosEnvironment, parse_value

ADDRESSES = ["127.0.0.1", "192.168.1.7", "10.0.0.2"]


def test_without_a_network_it_is_loopback() -> None:
    assert RosEnvironment.read({}, [], ["127.0.0.1"]).host == "127.0.0.1"
    assert RosEnvironment.read({}).host == "127.0.0.1"


@pytest.mark.parametrize(
    ("arguments", "variables", "host"),
    [
        (["__hostname:=a", "__ip:=1.1.1.1"], {"ROS_HOSTNAME": "b", "ROS_IP": "2.2.2.2"}, "a"),
        (["__ip:=1.1.1.1"], {"ROS_HOSTNAME": "b", "ROS_IP": "2.2.2.2"}, "1.1.1.1"),
        ([], {"ROS_HOSTNAME": "b", "ROS_IP": "2.2.2.2"}, "b"),
        ([], {"ROS_IP": "2.2.2.2"}, "2.2.2.2"),
        ([], {"ROS_HOSTNAME": "", "ROS_IP": ""}, "192.168.1.7"),
    ],
)
def test_the_order_of_addresses(arguments: list[str], variables: dict[str, str], host: str) -> None:
    environment = RosEnvironment.read(variables, arguments, ADDRESSES)
    assert environment.host == host
    assert environment.host_given == (host != "192.168.1.7")


def test_the_order_of_masters() -> None:
    variables = {"ROS_MASTER_URI": "http://base:11311/"}
    assert RosEnvironment.read(variables, ["__master:=http://pc:1"]).master_uri == "http://pc:1"
    assert RosEnvironment.read(variables).master_uri == "http://base:11311/"


@pytest.mark.parametrize(
    ("arguments", "variables", "text"),
    [
        ([], {"ROS_MASTER_URI": "localhost:11311"}, "ROS_MASTER_URI: 'localhost:11311' is not a master's URI"),
        ([], {"ROS_MASTER_URI": "http://localhost"}, "ROS_MASTER_URI"),
        ([], {"ROS_MASTER_URI": "http://localhost:0"}, "ROS_MASTER_URI"),
        (["__master:=http://x:99999"], {}, "__master:="),
        ([], {"ROS_IP": "http://1.2.3.4"}, "ROS_IP: 'http://1.2.3.4' is a URI"),
        ([], {"ROS_HOSTNAME": "a b"}, "ROS_HOSTNAME"),
        (["__nme:=x"], {}, "__nme:=: is not an argument of ROS; use one of __name"),
        (["__name:=a/b"], {}, "__name:="),
        (["__ns:=1"], {}, "__ns:="),
        ([], {"ROS_NAMESPACE": "~x"}, "ROS_NAMESPACE"),
        (["a:=1b"], {}, "a:=1b: does not remap one ROS name to another"),
    ],
)
def test_what_cannot_be_used_is_named(arguments: list[str], variables: dict[str, str], text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        RosEnvironment.read(variables, arguments)
    assert text in str(caught.value)


def test_remapping_arguments() -> None:
    environment = RosEnvironment.read(
        {"ROS_NAMESPACE": "other"},
        ["__name:=bob", "__ns:=/robot", "chatter:=speech", "/abs:=/there", "_rate:=10", "-v", "x", "~own:=/mine"],
    )
    assert environment.node_name("talker") == "/robot/bob"
    for name in ("", "/", "~"):
        with pytest.raises(ValueError, match="is not a node's name: it names the root namespace"):
            environment.node_name(name)
    assert environment.namespace == "/robot"
    assert environment.arguments == ("-v", "x")
    assert environment.parameters == {"rate": 10}
    node = "/robot/bob"
    assert environment.resolve("chatter", node) == "/robot/speech"
    assert environment.resolve("/robot/chatter", node) == "/robot/speech"
    assert environment.resolve("/abs", node) == "/there"
    assert environment.resolve("~own", node) == "/mine"
    assert environment.resolve("~else", node) == "/robot/bob/else"
    assert environment.resolve("/chatter", node) == "/chatter"


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1", 1), ("-7", -7), ("1.5", 1.5), ("1e3", 1000.0), ("99999999999", 99999999999.0), ("true", True),
        ("False", False), ("[1, 2]", [1, 2]), ('{"a": 1}', {"a": 1}), ('"7"', "7"), ("[broken", "[broken"),
        ("hello", "hello"), ("", ""),
    ],
)  # fmt: skip
def test_values_of_parameters(text: str, value: object) -> None:
    assert parse_value(text) == value
    assert type(parse_value(text)) is type(value)
