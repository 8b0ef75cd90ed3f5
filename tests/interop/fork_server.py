"""Starts Python programs by fork: whatever they import is there already. See ``forks``.

Usage: ``python fork_server.py MODULE...``: imports these, then reads requests of its standard input, a line of JSON
each, and writes events to its standard output: ``["started", PID]`` and ``["ended", PID, STATUS]``. A module with a
``!`` behind its name is executed anew in each program: it reads the arguments.
"""

import contextlib
import ctypes
import gc
import importlib
import json
import os
import runpy
import select
import signal
import sys
from pathlib import Path
from typing import Any

_CLONE_NEWNS, _CLONE_NEWNET = 0x00020000, 0x40000000
_MS_BIND, _MS_REC, _MS_SLAVE, _MNT_DETACH = 0x1000, 0x4000, 0x80000, 2
_PR_SET_PDEATHSIG, _PR_SET_NAME = 1, 15
_libc = ctypes.CDLL(None, use_errno=True)


def _serve() -> dict[str, Any]:
    """Fork for each request; returns the request in the child, and never in the server."""
    poll = select.poll()
    running: dict[int, int] = {}
    poll.register(0, select.POLLIN)
    unread = b""
    while True:
        for fd, _ in poll.poll():
            if fd:
                pid = running.pop(fd)
                poll.unregister(fd)
                os.close(fd)
                _say("ended", pid, os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
                continue
            if not (data := os.read(0, 1 << 20)):
                os._exit(0)
            *lines, unread = (unread + data).split(b"\n")
            for line in lines:
                request: dict[str, Any] = json.loads(line)
                places = (request["stdin"], os.O_RDONLY), (request["stdout"], os.O_WRONLY)
                files = [os.open(place, flags) for place, flags in places]
                if not (pid := os.fork()):
                    _become(request, files)
                    return request
                for opened in files:
                    os.close(opened)
                running[pidfd := os.pidfd_open(pid)] = pid
                poll.register(pidfd, select.POLLIN)
                _say("started", pid)


def _say(*event: object) -> None:
    os.write(1, json.dumps(event).encode() + b"\n")


def _become(request: dict[str, Any], files: list[int]) -> None:
    """Be a process as ``execve`` would have made it."""
    _checked(_libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL))
    _libc.prctl(_PR_SET_NAME, Path(request["argv"][0]).name.encode())
    os.setpgid(0, 0)
    for fd, opened in enumerate((*files, files[1])):
        os.dup2(opened, fd)
    os.closerange(3, 1024)
    if request["netns"]:
        _enter(request["netns"])
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["env"])
    sys.argv = request["argv"]
    paths = [each for each in request["env"].get("PYTHONPATH", "").split(os.pathsep) if each]
    sys.path[0:1] = [str(Path(request["argv"][0]).parent) if request["code"] is None else "", *paths]


def _enter(namespace: str) -> None:
    """As ``ip netns exec`` does it: a /sys that shows the interfaces there, and the namespace's files of /etc."""
    place = os.open(f"/run/netns/{namespace}", os.O_RDONLY)
    _checked(_libc.setns(place, _CLONE_NEWNET))
    os.close(place)
    _checked(_libc.unshare(_CLONE_NEWNS))
    _checked(_libc.mount(b"", b"/", b"none", ctypes.c_ulong(_MS_REC | _MS_SLAVE), None))
    _libc.umount2(b"/sys", _MNT_DETACH)
    _checked(_libc.mount(namespace.encode(), b"/sys", b"sysfs", ctypes.c_ulong(0), None))
    for ours in Path("/etc/netns", namespace).glob("*"):
        _checked(_libc.mount(bytes(ours), bytes(Path("/etc", ours.name)), b"none", ctypes.c_ulong(_MS_BIND), None))


def _checked(result: int) -> None:
    if result:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


if __name__ == "__main__":
    anew = []
    for word in sys.argv[1:]:
        with contextlib.suppress(ImportError):
            module = importlib.import_module(word.removesuffix("!"))
            anew += [module] * word.endswith("!")
    gc.collect()
    gc.freeze()
    asked = _serve()
    for module in anew:
        importlib.reload(module)
    if asked["code"] is None:
        runpy.run_path(asked["argv"][0], run_name="__main__")
    else:
        exec(asked["code"], {"__name__": "__main__", "__builtins__": __builtins__})
