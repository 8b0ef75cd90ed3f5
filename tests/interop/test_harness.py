"""The harness itself: nodes, shells and labs behave as the other tests expect."""

from __future__ import annotations

import shutil
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from lab.bed import namespaces
from lab.bed.agents import NotifySocket
from lab.bed.namespaces import Lab
from lab.bed.processes import CommandFailed, Deadline, Process, eventually, run

if TYPE_CHECKING:
    from collections.abc import Callable


CLIENTS = ["rospy", "roscpp"]


@pytest.mark.netns
def test_hosts_of_a_lab_reach_each_other_until_the_cable_is_cut(lab: Lab) -> None:
    a, b = lab.hosts("a", "b")
    run(a.command(["ping", "-c1", "-W2", b.address])) if _has("ping") else _connect(a, b)
    b.cut()
    assert "NO-CARRIER" in b.ip("link", "show", "eth0")
    b.restore()
    _connect(a, b)


@pytest.mark.netns
def test_router_joins_two_networks(lab: Lab) -> None:
    a = lab.host("a", 0)
    b = lab.host("b", 1)
    router = lab.router(0, 1)
    lab.route(a, router)
    lab.route(b, router)
    _connect(a, b)


@pytest.mark.nat
def test_two_networks_of_the_same_addresses_reach_out_behind_nat_and_are_not_reached(lab: Lab) -> None:
    outer = lab.host("outer", 0)
    lab.network(2, subnet=1)
    nats = [lab.nat(f"nat{inside}", inside, 0) for inside in (1, 2)]
    inner = [lab.host(f"inner{inside}", inside) for inside in (1, 2)]
    assert inner[0].address == inner[1].address
    for host, nat in zip(inner, nats, strict=True):
        lab.route(host, nat)
        assert _connect(host, outer) == nat.cables[1].address
        outer.ip("route", "replace", host.address, "via", nat.cables[1].address)
        with pytest.raises(CommandFailed, match=r"timed out|unreachable|No route"):
            _connect(outer, host, timeout=0.5)


@pytest.mark.netns
def test_shaping_is_set_and_taken_away(lab: Lab) -> None:
    (a,) = lab.hosts("a")
    a.shape("10mbit")
    assert "tbf" in run(a.command(["tc", "qdisc", "show", "dev", "eth0"]))
    a.unshape()
    assert "tbf" not in run(a.command(["tc", "qdisc", "show", "dev", "eth0"]))


@pytest.mark.netns
def test_lab_vanishes_with_what_runs_in_it() -> None:
    with Lab() as lab:
        (a,) = lab.hosts("a")
        process = Process(a.command(["sleep", "1000"]))
    assert process.wait() == -9
    process.end()
    assert (
        a.namespace not in subprocess.run(["ip", "netns", "list"], capture_output=True, text=True, check=True).stdout
    )


@pytest.mark.netns
def test_stale_namespaces_are_removed_but_not_ours() -> None:
    gone = subprocess.Popen(["true"])
    gone.wait()
    stale = f"rmpa-{gone.pid}-1-a"
    subprocess.run(["ip", "netns", "add", stale], check=True)
    with Lab() as lab:
        (mine,) = lab.hosts("mine")
        removed = namespaces.remove_stale()
        assert stale in removed
        assert mine.namespace not in removed
        mine.ip("link")


def test_process_waits_with_a_deadline_and_shows_its_last_lines() -> None:
    with Process(["sh", "-c", 'echo one; echo \'@ {"event": "up", "n": 3}\'; sleep 100'], name="child") as child:
        child.wait_for("^one$")
        assert child.wait_event("up") == {"event": "up", "n": 3}
        with pytest.raises(Deadline, match=r"child\| one"):
            child.wait_for("two", timeout=0.05)
    assert child.returncode == -15


def test_process_that_ends_early_fails_the_wait_at_once() -> None:
    with Process(["sh", "-c", "exit 3"]) as child, pytest.raises(Deadline, match="ended with status 3"):
        child.wait_for("never")


def test_group_of_a_process_ends_with_it() -> None:
    with Process(["sh", "-c", "sleep 1000 & echo $!; trap '' TERM; wait; wait"]) as child:
        grandchild = int(child.wait_for(r"^(\d+)$").group(1))
    eventually(lambda: not _lives(grandchild), what="the grandchild gone")


async def test_waits_leave_the_loop_running() -> None:
    with Process(["sh", "-c", "sleep 0.05; echo late"]) as child:
        await child.expect("late")
        assert await child.ended() == 0


def test_notify_socket_hears_ready() -> None:
    notify = NotifySocket()
    say = f"import socket as s; s.socket(s.AF_UNIX, s.SOCK_DGRAM).sendto(b'READY=1\\nSTATUS=x', {str(notify.path)!r})"
    with Process(["python3", "-c", f"{say}; import time; time.sleep(60)"]) as child:
        notify.wait_for("READY=1", child)
    notify.close()


@pytest.mark.parametrize("leak", ["asyncio.get_running_loop().create_task(asyncio.sleep(100))", "made()"])
def test_leaks_fail_the_test_that_made_them(pytester_like: Callable[[str], str], leak: str) -> None:
    body = f"""
        import asyncio, socket
        kept = []
        def made():
            kept.append(socket.socket())
        async def test_leaking():
            x = {leak}
    """
    assert "left" in pytester_like(body)


@pytest.fixture
def pytester_like(tmp_path: Path) -> Callable[[str], str]:
    """Run one test file under this tree's conftest in a process of its own; return its output, which must fail."""

    def outcome(body: str) -> str:
        root = Path(__file__).parents[2]
        path = tmp_path / "test_probe.py"
        path.write_text(textwrap.dedent(body), encoding="utf-8")
        argv: list[str | Path] = [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "-c",
            root / "pyproject.toml",
            "--rootdir",
            root,
        ]
        done = subprocess.run(
            [*argv, "-p", "tests.conftest", "-p", "no:cacheprovider", path],
            cwd=root,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 1, done.stdout + done.stderr
        return done.stdout

    return outcome


def _lives(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def _has(word: str) -> bool:
    return shutil.which(word) is not None


def _connect(a: namespaces.Host, b: namespaces.Host, timeout: float = 10.0) -> str:
    """Open a TCP connection from one host to the other; return the address that it comes from there."""
    serve = "import socket; s = socket.create_server(('', 7000)); print('ready', flush=True); print(s.accept()[1][0])"
    dial = f"import socket; socket.create_connection(('{b.address}', 7000), {timeout}).close()"
    with Process(b.command(["python3", "-c", serve])) as server:
        server.wait_for("ready")
        run(a.command(["python3", "-c", dial]))
        server.wait()
        return server.lines[-1]
