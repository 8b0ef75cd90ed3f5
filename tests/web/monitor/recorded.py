"""Recordings of the fake server's modules, and a program in the place of the commands that make their files."""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any, Final

from aiohttp import web

from rmpa.web.hub.node_link import EVERYTHING
from rmpa.web.server.access import Problem
from rmpa.web.server.recordings import ROUTE, RecordingFiles

FELL: Final = "20261129-121500-pc-it_fell"
ALARM: Final = "20261129-120312-base-alarm"
_SECOND: Final = 1_000_000_000
# ``fetch`` waits for the pipe ``gate``, if there is one: a test sees it under way.
_PROGRAM: Final = """
import json, pathlib, sys
words = sys.argv[1:]
out = pathlib.Path(words[words.index("-o") + 1])
if words[2:3] == ["bad"]:
    print(json.dumps({"error": "no module has a recording bad", "code": "unknown-name"}))
    sys.exit(1)
elif words[1] == "fetch":
    out.mkdir(exist_ok=True)
    (out / "1.mcap").write_bytes(bytes(3_000_000))
    gate = out.parents[2] / "gate"
    gate.exists() and gate.read_bytes()
else:
    out.write_bytes(b"made")
if words[0] == "story":
    begin = 1_795_954_500_000_000_000
    def line(at, module, level, kind, text, evidence):
        at = begin + round(at * 1e9)
        return {"at": at, "module": module, "level": level, "kind": kind, "text": text, "evidence": evidence}
    lines = [
        line(3.2, "velocity", "info", "profile", "/velocity runs smooth in place of full", "/velocity/profile"),
        line(31.5, "base", "warn", "gap", "/odom of /base was silent for 1.42 s; usual are 0.02 s", "/odom"),
        line(32.1, "pc", "error", "peer_lost", "base is lost: nothing was heard for 2.0 s", "/rmpa/events"),
        line(32.9, "base", "error", "log", "/base says: <b>motor 2 has no current</b>", "/rosout"),
        line(33.0, "velocity", "warn", "alarm", "non-adaptable: rate 3 Hz is below 10 Hz", "/rmpa/events"),
        line(41.7, "base", "error", "node_died", "/base does not answer: refused", "/rmpa/events"),
        line(52.4, "velocity", "info", "profile", "/velocity runs full in place of smooth", "/velocity/profile"),
    ]
    notes = ["Times are by the clock of pc.",
             "Of two modules, what is nearer than 0.62 ms may have happened in the other order."]
    print(json.dumps({"title": words[1], "begin": begin, "end": begin + 60 * 10**9, "modules":
        ["base", "pc", "velocity"], "messages": 48211, "lines": lines, "notes": notes}))
"""


def command(*words: str) -> list[str]:
    """The program, for these words of a command line."""
    return [sys.executable, "-c", _PROGRAM, *words]


class Recordings:
    """What the modules have kept, and the files of it."""

    def __init__(self) -> None:
        # Where files are made, while it is served.
        self.folder = Path()
        self._removed: set[str] = set()

    def add_to(self, app: web.Application) -> None:
        """Serve files."""
        app.router.add_get(ROUTE, self._respond)
        app.cleanup_ctx.append(self._serve)

    async def _serve(self, _app: web.Application) -> AsyncIterator[None]:
        with tempfile.TemporaryDirectory() as folder:
            self.folder = Path(folder)
            place = self.folder / "web"
            self._files = RecordingFiles(EVERYTHING, place, str, view=True, command=command)
            yield
            await self._files.end()
            await self._files.close()

    async def _respond(self, request: web.Request) -> web.StreamResponse:
        try:
            return await self._files.respond(request)
        except Problem as problem:
            return web.Response(status=problem.status, body=problem.body)

    def answer(self, what: str, args: dict[str, Any]) -> Any:
        """The answer to a question of a page."""
        if what == "keep_recording":
            return {"pc": "", "base": "", "joystick": "its agent is of an earlier release"}
        if what == "remove_recording":
            self._removed.add(args["name"])
            return {}
        return self._list()

    def _list(self) -> list[dict[str, Any]]:
        now = time.time_ns()

        def one(name: str, why: str, ago: int, size: int) -> dict[str, Any]:
            return {"id": name, "why": why, "until": now - ago * _SECOND, "size": size}

        fell, alarm = ("it fell over at the table", 60), ("non-adaptable: rate 3 Hz is below 10 Hz", 900)
        of = {
            "pc": [one(FELL, *fell, 8_200_000)],
            "base": [one(FELL, *fell, 31_400_000), one(ALARM, *alarm, 28_000_000)],
            "velocity": [one(ALARM, *alarm, 1_900_000)],
        }
        runs = {"pid": 7, "ring": [31_400_000, 119.0], "written": 912_000_000}
        full = runs | {"ring": [512_000_000, 41.0], "problem": "the disk is full: nothing is recorded"}
        states: dict[str, Any] = {"pc": runs, "base": runs | {"ring": [8_210_000, 120.0]}, "velocity": full}
        told = [
            {"module": name, "status": status, "kept": [one for one in of[name] if one["id"] not in self._removed]}
            for name, status in states.items()
        ]
        problem = "its agent is of an earlier release"
        return [*told, {"module": "joystick", "kept": [], "status": {}, "problem": problem}]
