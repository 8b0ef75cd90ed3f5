"""Python programs of tests are forked from servers that have imported what they need: most of a start is imports."""

from __future__ import annotations

import functools
import json
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from lab.bed import processes
from lab.bed.agents import RMPA, USER
from lab.bed.ros import PYTHON

_AGENT: Final = ("rmpa.cli.main", "rmpa.cli.agent", "rmpa.agent.process", "cryptography.x509", "ssl")
_ROS: Final = (
    "rospy",
    "rospy.names!",
    "rostopic",
    "rosservice!",
    "rosnode",
    "rosparam",
    "std_msgs.msg",
    "sensor_msgs.msg",
)
_TOOLS: Final = {"rosmaster", "rosnode", "rosparam", "rosservice", "rostopic"}
_STARTS: Final = 30.0
# Variables of the interpreter that a fork can have; with others a program is executed.
_OURS: Final = {"PYTHONUNBUFFERED", "PYTHONPATH", "PYTHONDONTWRITEBYTECODE"}


class ForkServer:
    """A process that forks for each program; it ends with this process.

    Args:
        python: Its interpreter.
        modules: What it imports first, if it is there.
    """

    def __init__(self, python: str, modules: Sequence[str]) -> None:
        self._news = threading.Condition()
        self._started: list[int] = []
        self._ended: dict[int, int] = {}
        kept = {key: value for key, value in os.environ.items() if not key.startswith(("ROS_", "RMPA_", "PYTHON"))}
        argv = [python, str(Path(__file__).with_name("fork_server.py")), *modules]
        self._child = subprocess.Popen(
            [*processes.tied_to_us(), *argv],
            env={**kept, "PYTHONUNBUFFERED": "1", "PYTHONPATH": USER},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            process_group=0,
        )
        threading.Thread(target=self._read, name="fork server", daemon=True).start()

    def start(self, request: Mapping[str, object]) -> int:
        """Start a program; return its process id."""
        with self._news:
            assert self._child.stdin is not None
            os.write(self._child.stdin.fileno(), json.dumps(request).encode() + b"\n")
            if not self._news.wait_for(lambda: self._started, _STARTS):
                raise processes.Deadline("a fork server does not answer")
            return self._started.pop()

    def ended(self, pid: int, timeout: float | None) -> int | None:
        """Its exit status, if it has ended by then."""
        with self._news:
            self._news.wait_for(lambda: pid in self._ended, timeout)
            return self._ended.get(pid)

    def _read(self) -> None:
        assert self._child.stdout is not None
        for line in self._child.stdout:
            what, pid, *status = json.loads(line)
            with self._news:
                if what == "started":
                    self._ended.pop(pid, None)
                    self._started.append(pid)
                else:
                    self._ended[pid] = status[0]
                self._news.notify_all()


class Forked(subprocess.Popen[str]):
    """A program that a server has started.

    Args:
        server: The server.
        request: What to start; see ``fork_server``.
        commands: Whether its standard input is a pipe.
    """

    def __init__(self, server: ForkServer, request: dict[str, object], *, commands: bool) -> None:
        self._server = server
        self.args = [str(request["argv"])]
        said, say = os.pipe()
        told, tell = os.pipe() if commands else (-1, -1)
        places = {"stdout": f"/proc/{os.getpid()}/fd/{say}"}
        places["stdin"] = f"/proc/{os.getpid()}/fd/{told}" if commands else os.devnull
        self.pid = server.start({**request, **places})
        self.returncode: int | None = None
        os.close(say)
        self.stdout = os.fdopen(said, encoding="utf-8", errors="backslashreplace")
        self.stdin = None
        if commands:
            os.close(told)
            self.stdin = os.fdopen(tell, "w", encoding="utf-8")

    def poll(self) -> int | None:
        """Its exit status if it has ended."""
        if self.returncode is None:
            self.returncode = self._server.ended(self.pid, 0.0)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Its exit status, as soon as it has ended."""
        self.returncode = self.returncode if self.returncode is not None else self._server.ended(self.pid, timeout)
        if self.returncode is None:
            raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        return self.returncode


@functools.cache
def _server(python: str) -> ForkServer:
    return ForkServer(python, _ROS if python == PYTHON else _AGENT)


def popen(argv: list[str], **options: Any) -> subprocess.Popen[str]:
    """Start a program as ``subprocess.Popen`` does, and by a fork if a server can."""
    words = argv[4:] if argv[1:2] == ["--pdeathsig"] else argv
    namespace = words[3] if words[:3] == ["ip", "netns", "exec"] else ""
    words = words[4:] if namespace else words
    env = options["env"]
    found = _found(words, env["PATH"])
    strange = {key for key in env if key.startswith("PYTHON")} - _OURS
    if found is None or strange or options["pass_fds"]:
        return subprocess.Popen(argv, **options)
    python, words, code = found
    request = {"argv": words, "code": code, "env": env, "netns": namespace, "cwd": str(Path.cwd())}
    return Forked(_server(python), request, commands=options["stdin"] == subprocess.PIPE)


def _found(words: list[str], path: str) -> tuple[str, list[str], str | None] | None:
    """The interpreter of a Python program, its arguments, and its code if they have it; ``None`` if it is not one."""
    if words[0] in {PYTHON, sys.executable}:
        if words[1] == "-c":
            return words[0], ["-c", *words[3:]], words[2]
        return (words[0], words[1:], None) if words[1].endswith(".py") else None
    if words[0] == str(RMPA):
        return sys.executable, words, None
    if words[0] in _TOOLS and (place := shutil.which(words[0], path=path)):
        return PYTHON, [place, *words[1:]], None
    return None
