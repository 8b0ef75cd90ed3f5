"""Clients that others wrote, unmodified: roslibjs 1.x and 2.x, @foxglove/ws-protocol, and roslibpy's own tests.

They are skipped where npm, the packages or a network namespace are missing.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT: Final = Path(__file__).parents[3]
CLIENTS: Final = Path(__file__).parent / "clients"
SERVE: Final = [sys.executable, "-m", "tests.web.gateways.serve"]
INSTALL: Final = 120.0
RUN: Final = 120.0
ROSLIBPY: Final = "2.1.0"
NEEDS_A_NODE_OF_ITS_OWN: Final = "test_tf.py::test_tf_test"
"""tf2_web_republisher has to run, which is a node in C++ of its own repository."""


@contextlib.contextmanager
def serving() -> Iterator[int]:
    """The port of both gateways, in a process of their own."""
    with subprocess.Popen(
        [*SERVE, "0"], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as server:
        assert server.stdout is not None
        try:
            yield int(server.stdout.readline())
        finally:
            server.communicate()


def npm(folder: Path, *packages: str) -> Path:
    """A folder with these packages."""
    program = shutil.which("npm")
    if program is None or shutil.which("node") is None:
        pytest.skip("node and npm are not installed")
    folder.joinpath("package.json").write_text(json.dumps({"private": True}))
    arguments = ["install", "--no-audit", "--no-fund", "--ignore-scripts", "--prefer-offline", *packages]
    try:
        done = subprocess.run([program, *arguments], cwd=folder, capture_output=True, timeout=INSTALL, check=False)
    except subprocess.TimeoutExpired:
        pytest.skip("npm reaches no registry")
    if done.returncode:
        pytest.skip("npm does not find the packages")
    return folder


@pytest.mark.timeout(INSTALL + 2 * RUN)
@pytest.mark.parametrize(
    ("script", "packages"),
    [
        ("roslib.mjs", ["roslib@1.4.1"]),
        ("roslib.mjs", ["roslib@2.1.0"]),
        ("foxglove.mjs", ["@foxglove/ws-protocol@0.8", "ws@8"]),
    ],
    ids=["roslib 1", "roslib 2", "foxglove"],
)
def test_a_javascript_client_works_unmodified(script: str, packages: list[str], tmp_path: Path) -> None:
    folder = npm(tmp_path, *packages)
    with serving() as port:
        done = subprocess.run(
            ["node", str(CLIENTS / script), str(folder), f"ws://127.0.0.1:{port}"],
            capture_output=True,
            timeout=RUN,
            text=True,
            check=False,
        )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "ok"


@pytest.mark.netns
@pytest.mark.timeout(4 * RUN)
@pytest.mark.parametrize("transport", ["twisted", "asyncio"])
def test_roslibpys_own_tests_pass(transport: str, tmp_path: Path) -> None:
    if importlib.util.find_spec("roslibpy") is None:
        pytest.skip("roslibpy is not installed (extra web-peers)")
    if shutil.which("unshare") is None or os.geteuid() != 0:
        pytest.skip("roslibpy's tests take port 9090, for which a network namespace is made: needs root")
    folder = roslibpy_source(tmp_path)
    shell = (
        f"ip link set lo up && {' '.join(SERVE)} 9090 < {tmp_path}/end > {tmp_path}/port & exec 3> {tmp_path}/end; "
        f"while ! grep -q 9090 {tmp_path}/port; do :; done; cd {folder}; "
        f"{sys.executable} -m pytest -q -p no:cacheprovider -c /dev/null --rootdir . tests/ros1 "
        f"--deselect tests/ros1/{NEEDS_A_NODE_OF_ITS_OWN}; code=$?; exec 3>&-; wait; exit $code"
    )
    os.mkfifo(tmp_path / "end")
    done = subprocess.run(
        ["unshare", "--net", "sh", "-c", shell],
        cwd=ROOT,
        env={**os.environ, "ROSLIBPY_TRANSPORT": transport},
        capture_output=True,
        timeout=2 * RUN,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "24 passed" in done.stdout


def roslibpy_source(folder: Path) -> Path:
    """Its source distribution, which has its tests."""
    command = [sys.executable, "-m", "pip", "download", "-q", "--no-deps", "--no-binary", ":all:", "-d", str(folder)]
    try:
        done = subprocess.run([*command, f"roslibpy=={ROSLIBPY}"], capture_output=True, timeout=INSTALL, check=False)
    except subprocess.TimeoutExpired:
        pytest.skip("pip reaches no registry")
    if done.returncode:
        pytest.skip("pip does not find roslibpy's sources")
    with tarfile.open(next(folder.glob("roslibpy-*.tar.gz"))) as archive:
        archive.extractall(folder, filter="data")
    return folder / f"roslibpy-{ROSLIBPY}"
