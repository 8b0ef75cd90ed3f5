"""The harness itself: nodes, shells and labs behave as the other tests expect."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path

import pytest


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
