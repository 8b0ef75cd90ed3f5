"""Both systems: they come up, carry messages, lose a host as by a pulled plug, and get it back."""

from __future__ import annotations

import os
import subprocess
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import psutil
import pytest

from lab.bed import namespaces
from lab.bed.plan import Kind, Plan, Transport
from lab.bed.processes import BedError, Deadline, eventually, run
from lab.bed.stage import make_stage
from lab.experiments import flow

if TYPE_CHECKING:
    from collections.abc import Iterator

    from lab.bed.plan import Client
    from lab.bed.processes import Process
    from lab.bed.stage import Stage
    from lab.bed.system import System

pytestmark = [pytest.mark.timeout(180), pytest.mark.ros, pytest.mark.netns]
HOSTS = ["joystick", "velocity", "pc"]
TOPICS = ["/cmd", "/vel"]
PLAN = Plan(clients=("roscpp",))
KINDS: tuple[Kind, ...] = get_args(Kind)
TRANSPORTS: tuple[Transport, ...] = get_args(Transport)
of_both_kinds = pytest.mark.parametrize("kind", KINDS)


@contextmanager
def _system(kind: Kind) -> Iterator[tuple[Stage, System]]:
    with make_stage(PLAN) as stage, stage.system(kind, HOSTS) as robot:
        yield stage, robot


def _nodes(robot: System, stage: Stage) -> tuple[Process, Process]:
    """A source on joystick, a velocity node on its host and a sink on pc, through which messages come."""
    client: Client = stage.plan.clients[0]
    sink = robot.node("pc", "sink", client, nodelay=True)
    robot.node("velocity", "velocity", client, nodelay=True)
    source = robot.node("joystick", "source", client)
    flow.wait_connected(source)
    flow.wait_flowing(source, sink, TOPICS, stage.scratch)
    return source, sink


def _running(kind: Kind) -> set[str]:
    """The names of what a system itself runs."""
    if kind == "rmpa":
        return {f"agent@{host}" for host in HOSTS}
    return {"roscore@pc", "master@pc", "rosout@pc"}


def _children() -> set[int]:
    return {child.pid for child in psutil.Process().children(recursive=True)}


@of_both_kinds
def test_messages_flow_unless_the_cable_is_cut_and_nothing_is_left_behind(kind: Kind) -> None:
    before, namespaces = _children(), _namespaces()  # beds of other tests may stand yet
    with _system(kind) as (stage, robot):
        assert robot.kind == kind
        assert robot.hosts == tuple(HOSTS)
        assert robot.master == ("pc" if kind == "classic" else "")
        source, sink = _nodes(robot, stage)
        begun = flow.begin(source, stage.scratch, size=64, rate=100, count=20)
        assert len(flow.sent(begun)) == 20
        assert len(flow.noted(sink, TOPICS, stage.scratch, begun.number)) == 40
        robot.cut("joystick")
        begun = flow.begin(source, stage.scratch, size=64, rate=100, count=10)
        flow.sent(begun)
        assert flow.noted(sink, TOPICS, stage.scratch, begun.number).empty
        robot.restore("joystick")
        flow.wait_flowing(source, sink, TOPICS, stage.scratch, timeout=60.0)
        eventually(lambda: set(robot.pids()) == _running(kind), what="all that the system itself runs")
        assert all(psutil.pid_exists(pid) for pid in robot.pids().values())
        scratch = stage.scratch
    assert not scratch.exists()
    assert not _children() - before
    assert not _namespaces() - namespaces


def test_direct_is_from_node_to_node_and_relayed_is_not() -> None:
    with make_stage(PLAN) as stage:
        for way in TRANSPORTS:
            with stage.system("rmpa", HOSTS[1:], way=way) as robot:
                sink = robot.node("pc", "sink", PLAN.clients[0], topics="/cmd")
                source = robot.node("velocity", "source", PLAN.clients[0])
                flow.wait_connected(source)
                robot.require_transport([(source, sink)])
                flow.wait_flowing(source, sink, ["/cmd"], stage.scratch)
                if way == "direct":
                    with pytest.raises(BedError, match="should be relayed is direct"):
                        robot.require_transport([(source, sink)], "relay")


@of_both_kinds
def test_killed_host_ends_all_at_once_and_comes_back(kind: Kind) -> None:
    with _system(kind) as (stage, robot):
        source, sink = _nodes(robot, stage)
        client = PLAN.clients[0]
        on_host = [process for process in _all(robot, "velocity") if process.returncode is None]
        assert on_host
        host = robot._place.host("velocity")
        addresses = host.address, host.ip("-brief", "link", "show", "eth0").split()[2]
        robot.kill("velocity")
        assert all(process.returncode is not None for process in on_host)
        assert not [name for name in robot.pids() if name.endswith("@velocity")]
        begun = flow.begin(source, stage.scratch, size=64, rate=100, count=10)
        flow.sent(begun)
        came = flow.noted(sink, TOPICS, stage.scratch, begun.number)["topic"].tolist()
        assert (came.count("/cmd"), came.count("/vel")) == (10, 0)
        before = time.monotonic()
        assert before <= robot.start("velocity") <= time.monotonic()
        assert (host.address, host.ip("-brief", "link", "show", "eth0").split()[2]) == addresses
        assert host.address in host.ip("address", "show", "eth0")
        robot.linked()
        robot.node("velocity", "velocity", client, nodelay=True)
        flow.wait_flowing(source, sink, TOPICS, stage.scratch)
        assert set(robot.pids()) >= ({"agent@velocity"} if kind == "rmpa" else {"master@pc"})


def test_classic_without_its_master_takes_no_new_node_until_it_is_back() -> None:
    with _system("classic") as (stage, robot):
        _nodes(robot, stage)
        client = PLAN.clients[0]
        robot.kill("pc")
        assert not robot.pids()
        lost = robot.node("velocity", "sink", client, wait=False, topics="/cmd")
        with pytest.raises(Deadline):
            lost.wait_event("up", 1.5)
        robot.start("pc")
        sink = robot.node("pc", "sink", client, nodelay=True, topics="/cmd")
        fresh = robot.node("joystick", "source", client)  # the old one does not register with the new master
        flow.wait_flowing(fresh, sink, ["/cmd"], stage.scratch)


def _all(robot: System, host: str) -> list[Process]:
    return [*robot._shells[host].processes, *robot._own(host)]


class TestCables:
    @pytest.mark.parametrize(("link", "bands"), [("100mbit", True), ("100mbit", False), ("", True)])
    def test_cables_carry_what_was_asked_for_and_still_do_after_a_restart(self, link: str, bands: bool) -> None:
        more: Any = {"config": "domain = 7\n", "flags": ["--realtime"]}
        with make_stage(PLAN) as stage, stage.system("rmpa", ["a"], link=link, bands=bands, **more) as robot:
            words = robot._own("a")[0].argv
            assert "--realtime" in words
            config = Path(words[words.index("--config") + 1])
            assert config.read_text(encoding="utf-8").startswith("domain = 7\n")
            for _ in range(2):
                shown = run(robot._place.host("a").command(["tc", "qdisc", "show", "dev", "eth0"]))
                assert ("tbf" in shown, "100Mbit" in shown) == (bool(link), bool(link))
                assert ("pfifo_fast" in shown) == bool(link and bands)
                robot.kill("a")
                robot.start("a")

    def test_traffic_is_counted_and_a_pulled_plug_tells_nobody(self) -> None:
        """A killed process's kernel closes its connections; a host without power does not, so others keep theirs."""
        with _system("classic") as (stage, robot):
            source, sink = _nodes(robot, stage)
            before = robot.traffic("joystick"), robot.traffic("pc")
            begun = flow.begin(source, stage.scratch, size=10_000, rate=100, count=20)
            flow.sent(begun)
            flow.noted(sink, TOPICS, stage.scratch, begun.number)
            after = robot.traffic("joystick"), robot.traffic("pc")
            # To pc and to velocity; from joystick and from velocity.
            for was, now, way in zip(before, after, ("tx", "rx"), strict=True):
                assert now[f"{way}_bytes"] - was[f"{way}_bytes"] > 2 * 20 * 10_000
                assert now[f"{way}_packets"] > was[f"{way}_packets"]
            address = robot._place.host("velocity").address
            standing = _connections(robot, address)
            robot.kill("velocity")
            # The source's packets to it are lost by now, and nothing has come back.
            flow.sent(flow.begin(source, stage.scratch, size=64, rate=100, count=10))
            assert standing
            assert _connections(robot, address) == standing
            assert not [event for event in source.events("connected") if event["subscribers"] == 1][1:]


def _connections(robot: System, address: str) -> set[str]:
    """The established connections of joystick to an address, as ``ss`` names them."""
    here = robot._place.host("joystick")
    shown = run(here.command(["ss", "-Htn", "state", "established", "dst", address]))
    return {" ".join(line.split()[2:4]) for line in shown.splitlines()}


def _namespaces() -> set[str]:
    """Those that this process has made."""
    if namespaces.why_not():
        return set()
    listed = subprocess.run(["ip", "netns", "list"], capture_output=True, text=True, check=True).stdout
    return {line for line in listed.splitlines() if f"-{os.getpid()}-" in line}
