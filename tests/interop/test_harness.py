"""The harness itself: nodes, shells and labs behave as the other tests expect."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from lab.bed import namespaces
from lab.bed.namespaces import Lab
from lab.bed.processes import CommandFailed, Process, eventually, run
from tests.interop.conftest import Beds

if TYPE_CHECKING:
    from collections.abc import Callable


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
def test_lab_vanishes_with_what_runs_in_it() -> None:
    with Lab() as lab:
        (a,) = lab.hosts("a")
        process = Process(a.command(["sh", "-c", "echo inside; exec sleep 1000"]))
        process.wait_for("inside")
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


def test_group_of_a_process_ends_with_it() -> None:
    with Process(["sh", "-c", "sleep 1000 & echo $!; trap '' TERM; wait; wait"]) as child:
        grandchild = int(child.wait_for(r"^(\d+)$").group(1))
    eventually(lambda: not _lives(grandchild), what="the grandchild gone")


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


def _connect(a: namespaces.Host, b: namespaces.Host, timeout: float = 10.0) -> str:
    """Open a TCP connection from one host to the other; return the address that it comes from there."""
    serve = "import socket; s = socket.create_server(('', 7000)); print('ready', flush=True); print(s.accept()[1][0])"
    dial = f"import socket; socket.create_connection(('{b.address}', 7000), {timeout}).close()"
    with Process(b.command(["python3", "-c", serve])) as server:
        server.wait_for("ready")
        run(a.command(["python3", "-c", dial]))
        server.wait()
        return server.lines[-1]


@pytest.mark.netns
def test_a_bed_serves_another_test_only_as_it_was_at_first(tmp_path: Path) -> None:
    beds = Beds(tmp_path)
    try:
        key, first = beds.take(("a", "b"), {})
        beds.give_back(key, first)
        key, again = beds.take(("a", "b"), {})
        assert again is first
        first.agents[0].kill()
        beds.give_back(key, first)
        key, other = beds.take(("a", "b"), {})
        assert other is not first
        beds.give_back(key, other)
    finally:
        beds.close()
