"""``rmpa node`` against our own core and nodes, without an agent and with one that knows a peer."""

from __future__ import annotations

import asyncio
import json
import os
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from rmpa.cli.node import _untold
from rmpa.core.errors import PeerRefused, UnreachableError
from rmpa.observe.snapshot import UnreachableInfo
from rmpa.ros.environment import NodeFacts, NodeLine, NodePing, PeerNodes, RosEnvironment
from rmpa.ros.node.node import Node
from tests.cli.conftest import with_core

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.ros.core.embedded import RosCore
    from tests.cli.conftest import Background, Rmpa

GROUP = ("node",)
JOY = "http://10.0.0.2:1/"


@pytest.fixture
def talker(core: RosCore, background: Background) -> Iterator[str]:
    """A node that ends at ``shutdown``, and a proxy as a bridge makes them; the node's slave API."""
    told = asyncio.Event()
    proxy = Node("/rmpa/joystick/joy", master_uri=core.uri, environment=RosEnvironment())
    made = Node("/talker", master_uri=core.uri, environment=RosEnvironment(), on_shutdown=lambda _: told.set())
    lives: list[asyncio.Task[None]] = []

    async def live() -> None:
        await told.wait()
        await made.close()

    async def start() -> None:
        await proxy.__aenter__()
        await made.__aenter__()
        await made.advertise("/chatter", "std_msgs/String")
        await proxy.advertise("/joy", "std_msgs/String")
        lives.append(asyncio.create_task(live()))

    async def stop() -> None:
        told.set()
        await lives[0]
        await proxy.close()

    background.do(start())
    yield core.state().nodes["/talker"]
    background.do(stop())


@pytest.fixture
def peer(core: RosCore, agent: Callable[..., None]) -> list[dict[str, Any]]:
    """An agent with this core, whose peer joystick has a node /joy; and the questions that it got."""
    asked: list[dict[str, Any]] = []

    def node(args: dict[str, object]) -> object:
        asked.append(args)
        if args["peer"] not in (None, "joystick"):
            raise UnreachableError("linked peer", repr(args["peer"]), "did you mean joystick?")
        if args["what"] == "node.list":
            shown = PeerNodes(peer="older", nodes=(NodeLine(name="/x"),), problem="it is older")
            line = NodeLine(name="/joy", uri=JOY, publications=1, problem="no answer in 3 s")
            joystick = PeerNodes(peer="joystick", nodes=(line,))
            return (joystick,) if args["peer"] else (shown, joystick)
        if args["node"] != "/joy":
            raise PeerRefused("joystick", f"joystick has no node {args['node']}")
        if args["what"] == "node.info":
            return NodeFacts(name="/joy", uri=JOY, pid=7, publications={"/joy": "*"}, services=("/joy/get_loggers",))
        return NodePing(uri=JOY, time=0.0005, pid=7) if args["what"] == "node.ping" else {"gone": True}

    lost = UnreachableInfo(node="/talker", uri="http://nosuch:1/", problem="no such name", ago=3.0)
    agent("base", msgspec.structs.replace(with_core(core.uri), unreachable=(lost,)), node=node)
    return asked


def test_without_an_agent_the_graph_is_shown(rmpa: Rmpa, talker: str) -> None:
    assert rmpa("list") == (0, "/rosout\n/talker\njoystick:/joy\n", "")
    assert rmpa("list", "joystick:/") == (0, "joystick:/joy\n", "")
    assert rmpa("list", "/talk")[1] == ""
    listed = json.loads(rmpa("list", "/talker", "--json")[1])
    assert listed == [
        {
            "name": "/talker",
            "peer": None,
            "module": None,
            "uri": talker,
            "publications": 1,
            "subscriptions": 0,
            "services": 0,
            "problem": None,
        }
    ]
    code, out, err = rmpa("info", "joystick:/joy")
    assert (code, out) == (1, "")
    assert "only an agent knows peers" in err


def test_info_and_ping(rmpa: Rmpa, talker: str) -> None:
    code, out, err = rmpa("info", "talker")
    assert (code, err) == (0, "")
    assert out.splitlines() == [
        "Node: /talker",
        "Module: none, for no agent runs at this master",
        f"URI: {talker}",
        f"Pid: {os.getpid()}",
        "",
        "Publications:",
        " * /chatter [std_msgs/String]",
        "",
        "Subscriptions: none",
        "",
        "Services: none",
    ]
    about = json.loads(rmpa("info", "/talker", "--json")[1])
    assert (about["pid"], about["reachable"], about["publications"]) == (
        os.getpid(),
        True,
        {"/chatter": "std_msgs/String"},
    )
    code, out, _ = rmpa("ping", "/talker", "-c", "2", "-i", "0.01")
    assert code == 0
    assert [line.split("time=")[0] for line in out.splitlines()] == [
        f"/talker ({talker}): seq=1 ",
        f"/talker ({talker}): seq=2 ",
    ]
    code, out, _ = rmpa("ping", "--all", "--json")
    assert (code, json.loads(out)["node"]) == (0, "/talker")
    code, out, err = rmpa("info", "/talked")
    assert (code, out, err) == (1, "", "rmpa: no node /talked; did you mean /talker? [unknown-name]\n")
    code, out, _ = rmpa("ping", "/talked", "-c", "1")
    assert (code, out) == (1, "/talked: seq=1 no node /talked; did you mean /talker?\n")


def test_a_node_that_does_not_answer(rmpa: Rmpa, core: RosCore, background: Background) -> None:
    async def register() -> None:
        core.call("registerPublisher", "/gone", "/t", "std_msgs/String", "http://127.0.0.1:9/")

    background.do(register())
    code, out, err = rmpa("info", "/gone")
    assert (code, "Pid: it does not answer" in out, "Connection refused" in err) == (0, True, True)
    code, out, _ = rmpa("ping", "/gone", "-c", "1", "--json")
    said = json.loads(out)
    assert (code, said["time"], "Connection refused" in said["error"]) == (1, None, True)


def test_kill(rmpa: Rmpa, talker: str, core: RosCore) -> None:
    code, out, err = rmpa("kill", "/talker", "/nobody", "/rmpa")
    assert (code, out) == (1, "killed /talker\n")
    assert err.splitlines() == [
        "rmpa: /nobody: no node /nobody; `rmpa node list` shows all [unknown-name]",
        "rmpa: /rmpa: it is the agent itself; end `rmpa up` instead [refused]",
    ]
    assert "/talker" not in core.state().nodes
    assert rmpa("kill")[0] == rmpa("kill", "--all", "/x")[0] == rmpa("ping")[0] == 2


def test_kill_all_leaves_what_is_not_of_this_module(rmpa: Rmpa, talker: str, core: RosCore) -> None:
    code, out, _ = rmpa("kill", "--all", "--json")
    assert (code, json.loads(out)) == (0, [{"node": "/talker", "killed": True, "error": None}])
    assert sorted(core.state().nodes) == ["/rmpa/joystick/joy", "/rosout"]


def test_nodes_of_peers(rmpa: Rmpa, talker: str, peer: list[dict[str, Any]]) -> None:
    code, out, err = rmpa("list")
    assert (code, out.splitlines()) == (0, ["/rosout", "/talker", "joystick:/joy", "older:/x"])
    assert err.splitlines() == [
        "! older does not list its nodes, only those with proxies here: it is older [refused]",
        f"! /talker cannot be reached at {talker}: no such name [node-unreachable]",
        f"! joystick:/joy cannot be reached at {JOY}: no answer in 3 s [node-unreachable]",
    ]
    rows = [line.split() for line in rmpa("list", "-v", "joystick:/")[1].splitlines()]
    assert rows[1] == ["joystick:/joy", "joystick", "1", "0", "0", JOY]
    for name in ("joystick:/joy", "/rmpa/joystick/joy"):
        out = rmpa("info", name)[1]
        assert out.splitlines()[:4] == ["Node: joystick:/joy", "Module: joystick", f"URI: {JOY}", "Pid: 7"]
        assert " * /joy [unknown type]" in out
    code, out, _ = rmpa("ping", "joystick:/joy", "-c", "1")
    assert (code, "(0.500 ms there) pid=7" in out) == (0, True)
    assert rmpa("kill", "joystick:/joy") == (0, "killed joystick:/joy\n", "")
    assert peer[-1] == {"what": "node.kill", "peer": "joystick", "node": "/joy"}
    code, out, err = rmpa("kill", "joystick:/jo", "joystik:/joy", "--json")
    assert code == 1
    assert [one["killed"] for one in json.loads(out)] == [False, False]
    assert "joystick has no node /jo" in err
    assert "did you mean joystick?" in err


def test_many_modules_that_do_not_tell_their_nodes_take_one_line() -> None:
    silent = [PeerNodes(peer=f"arm{number}", nodes=(), problem="it is stopped") for number in range(1000)]
    told = [*silent, PeerNodes(peer="base", nodes=()), PeerNodes(peer="leg", nodes=(), problem="it is older")]
    assert list(_untold(told)) == [
        "1,000 modules (arm0, arm1, arm2, ...) do not list their nodes, only those with proxies here: it is stopped",
        "leg does not list its nodes, only those with proxies here: it is older",
    ]
    assert next(_untold(silent[:2])).startswith("arm0, arm1 do not list")
