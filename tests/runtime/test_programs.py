"""Programs that outlive their starter: how one is known again, and how their logs are kept and read."""

from __future__ import annotations

import asyncio
import inspect
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from rmpa.runtime import limits
from rmpa.runtime.programs import (
    CpuShares,
    NodeRun,
    ProgramMark,
    ResourceRun,
    ended,
    figures,
    how_ended,
    keep_capabilities,
    read_log,
    rotate_log,
    start_program,
)


async def test_a_process_is_known_again_and_no_other_is_taken_for_it(tmp_path: Path) -> None:
    log = tmp_path / "log" / "one.log"
    words = ["sh", "-c", "echo $COLOUR in $PWD; exec sleep 100"]
    process = await asyncio.to_thread(start_program, words, log=log, cwd=tmp_path, env={"COLOUR": "red"})
    mark = ProgramMark.of(process.pid)
    assert mark is not None
    assert (mark.runs, mark.pid) == (True, process.pid)
    assert os.getsid(process.pid) == process.pid, "no signal of the starter's terminal reaches it"
    assert not mark._replace(began=mark.began + 1).runs
    assert not mark._replace(boot="another").runs
    about = figures(process.pid)
    assert about is not None
    assert abs(about.since - log.stat().st_mtime) < 60
    async with asyncio.timeout(30):
        while not log.read_text():
            await asyncio.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    await ended(process.pid)
    assert ProgramMark.of(process.pid) is None, "nobody has waited for it, and it does not run"
    assert figures(process.pid) is None
    process.wait()
    await ended(process.pid)
    assert log.read_text() == f"red in {tmp_path}\n"
    assert log.stat().st_mode & 0o777 == 0o600


def test_the_share_of_a_core_is_that_since_the_last_question() -> None:
    shares = CpuShares()
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as busy:
        first = figures(busy.pid)
        assert first is not None
        shares.of(busy.pid, first)
        assert shares.known(busy.pid)
        later = first._replace(cpu=first.cpu + 1e6)
        assert shares.of(busy.pid, later) > 1000
        assert shares.of(busy.pid, later) == 0
        busy.kill()


def test_what_a_resource_tells_is_kept(tmp_path: Path) -> None:
    mark = ProgramMark(1, 2, "boot")
    run = ResourceRun(process=mark, state="active", nodes=(NodeRun(key="a", node="/a", state="running", mark=mark),))
    run.save(tmp_path / "run" / "cam.json")
    assert ResourceRun.load(tmp_path / "run" / "cam.json") == run
    (tmp_path / "run" / "cam.json").write_text('{"process": 7}')
    assert ResourceRun.load(tmp_path / "run" / "cam.json") is ResourceRun.load(tmp_path / "none") is None


def test_a_log_is_read_on_from_where_it_was_left_also_over_its_rotation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "PROGRAM_LOG_MAX", 40)
    log = tmp_path / "one.log"
    assert read_log(log, None, 10) == ([], 0)
    with log.open("ab", buffering=0) as program:  # which knows nothing of the rotation
        program.write(b"one\n\x1b[31mtwo\x1b[0m\n")
        assert read_log(log, None, 1) == (["two"], 17)  # the place is that in the file
        lines, place = read_log(log, None, 10)
        assert lines == ["one", "two"]
        program.write(b"thr")
        assert read_log(log, place, 10) == ([], place), "a line is told when it is whole"
        program.write(b"ee\n")
        lines, place = read_log(log, place, 10)
        assert lines == ["three"]
        program.write(b"four, which is long enough\n")
        rotate_log(log)
        program.write(b"five\n")
        assert log.stat().st_size == 5
        lines, place = read_log(log, place, 10)
        assert lines == ["four, which is long enough", "five"]
        assert read_log(log, place, 10) == ([], place)
        assert read_log(log, None, 2)[0] == ["four, which is long enough", "five"]
        rotate_log(log)
        assert log.stat().st_size == 5, "it is small"
        program.write(b"x" * 3 * limits.PROGRAM_LOG_READ)
        (line,), _ = read_log(log, None, 10)
        assert len(line) == limits.PROGRAM_LOG_LINE


def test_each_exit_code_has_a_text() -> None:
    texts = [how_ended(code) for code in (None, 0, 3, -signal.SIGKILL, -(signal.SIGRTMIN + 6))]
    assert texts == [
        "has ended",
        "has ended with code 0",
        "has ended with code 3",
        "was ended by SIGKILL",
        "was ended by signal 40",
    ]


WHO = "import re; print(re.findall(r'CapEff:\\s*(\\w+)', open('/proc/self/status').read())[0])"


@pytest.mark.skipif(os.geteuid() != 0 or not shutil.which("setpriv"), reason="it takes root and setpriv")
def test_a_capability_of_the_units_is_not_that_of_the_nodes() -> None:
    program = (
        f"{inspect.getsource(keep_capabilities)}\nkeep_capabilities()\nsubprocess.run([sys.executable, '-c', WHO])"
    )
    script = f"import ctypes, subprocess, sys\n_CAP_AMBIENT, _CLEAR_ALL = 47, 4\nWHO = {WHO!r}\n{program}\nexec(WHO)"
    unit = ["setpriv", "--reuid", "65534", "--inh-caps", "+net_admin", "--ambient-caps", "+net_admin"]
    done = subprocess.run([*unit, "/usr/bin/python3", "-c", script], capture_output=True, text=True, check=False)
    if "setpriv" in done.stderr:
        pytest.skip(f"setpriv cannot do it here: {done.stderr.strip()}")
    node, agent = (int(line, 16) for line in done.stdout.split())
    assert (node, agent) == (0, 1 << 12), done
