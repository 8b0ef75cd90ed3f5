"""A board of arm64, emulated by qemu-user: the bundle runs there, and it speaks with an amd64 machine."""

from __future__ import annotations

import re
import tarfile
from pathlib import Path

import pytest

from lab.bed.agents import Agent
from lab.bed.namespaces import Lab
from tests.interop.ros import Ros
from tests.packages.machines import Machine
from tests.packages.ways import USER, bundle

pytestmark = [pytest.mark.packages, pytest.mark.ros, pytest.mark.timeout(1800)]
# Seconds for what takes ten on a board.
_SLOW = 240.0


def _unpack(archive: Path, home: Path) -> str:
    """Unpack the bundle, since the board has no xz; qemu-user has no SIOCETHTOOL, which psutil asks for speeds."""
    with tarfile.open(archive) as packed:
        packed.extractall(home, filter="tar")
    folder = home / archive.name.removesuffix(".tar.xz")
    (asks,) = folder.rglob("psutil/_pslinux.py")
    asks.write_text(asks.read_text().replace("cext.net_if_duplex_speed(name)", "(cext.DUPLEX_UNKNOWN, 0)"))
    for compiled in folder.rglob("psutil/__pycache__/_pslinux.*"):
        compiled.unlink()
    return f"./{folder.name}/rmpa"


def test_a_board_speaks_with_an_amd64_machine(tmp_path: Path) -> None:
    if (archive := bundle("aarch64")) is None:
        pytest.skip("nothing in dist for arm64: make bundle ARCH=aarch64")
    with Lab() as lab, Machine(lab.host("board", 0), "bullseye", "arm64", "bare") as board:
        desk = lab.host("desk", 0)
        with Agent(desk, tmp_path, name="desk") as agent, Ros(desk, tmp_path) as ros:
            agent.start()
            rmpa = _unpack(archive, board.root / f"home/{USER}")
            assert re.match(r"rmpa \d", board.run(rmpa, "--version", user=USER, timeout=_SLOW))
            up = board.start(rmpa, "up", user=USER)
            up.wait_for("ROS_MASTER_URI=", _SLOW)
            agent.wait_ready()
            agent.wait_peer("board", _SLOW)
            said = board.run("sh", "-c", f"{rmpa} doctor || true", user=USER, timeout=_SLOW)
            # qemu-user has no SO_REUSEPORT, so the board is found by the desk's beacons.
            fails = [line for line in said.splitlines() if line.startswith("fail")]
            assert [line for line in fails if "Protocol not available" not in line] == [], said
            assert "answers: " in said
            board.start(
                rmpa, "topic", "pub", "--rate", "5", "/from_board", "std_msgs/String", "from arm64", user=USER
            )
            ros.start("rostopic", "echo", "/from_board").wait_for("data: .*from arm64", _SLOW)
            ros.start("rostopic", "pub", "-r", "5", "/from_desk", "std_msgs/String", "from amd64")
            board.start(rmpa, "topic", "echo", "/from_desk", user=USER).wait_for("from amd64", _SLOW)
