"""``rmpa peer`` beside a fake agent."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable
from typing import TYPE_CHECKING

import msgspec
import pytest

from rmpa.core.errors import RmpaError
from rmpa.observe.peer_info import PeerInfo
from rmpa.observe.snapshot import PingReply
from tests.observe.samples import SNAPSHOT

if TYPE_CHECKING:
    from tests.cli.conftest import Place

Agent = Callable[..., None]


def test_list_in_a_pipe_is_plain_and_aligned(place: Place, agent: Agent) -> None:
    agent()
    code, out, err = place.run("peer", "list", "-v")
    assert code == 0
    head, joystick, pc = out.splitlines()
    assert head.split()[:4] == ["PEER", "STATE", "SINCE", "ADDRESS"]
    assert " ".join(joystick.split()) == (
        "joystick linked 1 min 2 s 10.0.0.2:40002 432 µs by us -1.25 ms ±216 µs 12.3 MB 1.23 kB 10 B 2"
    )
    assert pc.startswith("pc        linking")
    assert head.index("STATE") == joystick.index("linked") == pc.index("linking")
    assert "\x1b" not in out
    assert err.splitlines() == [
        "! no multicast on eth0",
        "! pc: shares its name with 10.0.0.9:40003#4; give one of them another --name",
        "! 1 node of laptop stays hidden",
        "! pc: connection refused; next attempt in 1.5 s",
    ]


def test_a_relayed_module_is_shown_with_its_relay(place: Place, agent: Agent) -> None:
    pad = PeerInfo(
        name="pad", guid="10.9.0.1:40001#1", instance="22" * 16, state="relayed", since_ago=0.0, via="base2"
    )
    pad = msgspec.structs.replace(pad, topics_in=3, last_error="no route to host")
    agent(snapshot=msgspec.structs.replace(SNAPSHOT, peers=(pad,), notes=()))
    code, out, err = place.run("peer", "list")
    assert (code, err) == (0, ""), "that there is no link is no trouble"
    assert out.splitlines()[1].split()[:5] == ["pad", "relayed", "-", "via", "base2"]
    code, out, _ = place.run("peer", "info", "pad")
    assert (code, out.splitlines()[2]) == (0, "State:        relayed: base2 passes on 3 topics that it publishes")


def test_list_as_json(place: Place, agent: Agent) -> None:
    agent()
    code, out, _ = place.run("peer", "list", "--json")
    assert code == 0
    assert msgspec.json.decode(out, type=tuple[PeerInfo, ...]) == SNAPSHOT.peers


def test_no_peers_says_where_it_looks(place: Place, agent: Agent) -> None:
    agent(snapshot=msgspec.structs.replace(SNAPSHOT, peers=(), notes=()))
    assert place.run("peer", "list") == (0, "base knows no peers yet (domain 3, looking on wlan0)\n", "")


def test_info(place: Place, agent: Agent) -> None:
    agent()
    code, out, _ = place.run("peer", "info", "joystick")
    assert code == 0
    assert "Round trip:   432 µs" in out
    assert "Clock:        -1.25 ms ± 216 µs (its clock less ours)" in out
    assert "Direct:       1 of the subscribers here to its nodes, 2 of its subscribers to nodes here" in out
    assert "Topics that it publishes:" in out
    (row,) = (line for line in out.splitlines() if "/cmd" in line)
    assert " ".join(row.split()) == "/cmd sensor_msgs/Joy /joy_node open 600 10.0 Hz 412 µs ±216 µs 790 µs 9"
    assert place.run("peer", "info", "10.0.0.2:40002")[1] == out


def test_an_unknown_peer(place: Place, agent: Agent) -> None:
    agent()
    message = "rmpa: base knows no peer 'joystik'; did you mean joystick?\n"
    assert place.run("peer", "info", "joystik") == (1, "", message)
    assert place.run("peer", "ping", "joystik") == (1, "", message)


def test_ping(place: Place, agent: Agent) -> None:
    agent()
    code, out, _ = place.run("peer", "ping", "joystick", "-c", "3", "-i", "0.01")
    assert code == 0
    assert out.splitlines() == [
        "joystick (10.0.0.2:40002): seq=1 time=0.400 ms",
        "joystick: seq=2 no answer",
        "joystick (10.0.0.2:40002): seq=3 time=0.600 ms",
        "",
        "--- joystick ping statistics ---",
        "3 sent, 2 received, 33 % lost",
        "rtt min/avg/max/sd = 0.400/0.500/0.600/0.100 ms",
    ]


def test_ping_addresses_a_peer_by_guid(place: Place, agent: Agent) -> None:
    asked: list[object] = []

    def note(args: dict[str, object]) -> PingReply:
        asked.append(args["peer"])
        return PingReply(times=(0.001,), remote="10.0.0.2:40002")

    agent(ping=note)
    assert place.run("peer", "ping", "joystick", "-c", "1")[0] == 0
    assert asked == [place.json("peer", "info", "joystick", "--json")[0]["guid"]]


def test_ping_as_json(place: Place, agent: Agent) -> None:
    agent()
    first, second, last = place.json("peer", "ping", "joystick", "-c", "2", "-i", "0.01", "--json")
    assert first == {"peer": "joystick", "seq": 1, "time": 0.0004, "remote": "10.0.0.2:40002"}
    assert second["time"] is None
    assert (last["sent"], last["received"]) == (2, 1)


def test_ping_without_an_answer_exits_1(place: Place, agent: Agent) -> None:
    def refuse(_: dict[str, object]) -> PingReply:
        raise RmpaError("no link to joystick")

    agent(ping=refuse)
    code, out, _ = place.run("peer", "ping", "joystick", "-c", "1")
    assert code == 1
    assert "seq=1 no link to joystick" in out
    assert "1 sent, 0 received, 100 % lost" in out


def test_ctrl_c_shows_the_summary(place: Place, agent: Agent) -> None:
    agent()
    with place.start("peer", "ping", "joystick", "-i", "0.01") as process:
        assert process.stdout is not None
        process.stdout.readline()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=30)
    assert "rtt min/avg/max/sd" in out
    assert (process.returncode, err) == (0, "")


@pytest.mark.parametrize("command", [("list",), ("info", "x"), ("ping", "x")])
def test_without_an_agent(place: Place, command: tuple[str, ...]) -> None:
    expected = f"rmpa: no agent answers at {place.path}; start one with `rmpa up`\n"
    assert place.run("peer", *command) == (1, "", expected)


def test_two_agents(place: Place, agent: Agent) -> None:
    agent("base")
    agent("second", snapshot=msgspec.structs.replace(SNAPSHOT, peers=()))
    code, _, err = place.run("peer", "list", "--json")
    assert code == 1
    assert "several agents run on this machine: base, second; name one with --agent NAME or RMPA_AGENT" in err
    assert place.run("peer", "list", "--json", "--agent", "second") == (0, "[]\n", "")


def test_a_closed_pipe_is_quiet(place: Place, agent: Agent) -> None:
    agent()
    with place.start("peer", "ping", "joystick", "-i", "0.01", "--json") as process:
        assert process.stdout is not None
        assert json.loads(process.stdout.readline())["seq"] == 1
        process.stdout.close()
        process.wait(30)
        assert process.stderr is not None
        assert process.stderr.read() == ""
    assert process.returncode == 141
