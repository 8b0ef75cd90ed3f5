"""What a user looks at in a mesh of a thousand modules, and what it costs the agent; ``views_agent`` is the agent."""

from __future__ import annotations

import http.client
import os
import subprocess
import sys
import tempfile
import xmlrpc.client
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from lab.bed.ros import free_port
from lab.findings import Claim
from lab.results import finish
from lab.tables import table_of
from rmpa.observe.io.control_client import ControlClient

if TYPE_CHECKING:
    from collections.abc import Callable

    from rich.console import Console

_NAME: Final = "views"
_TOPICS: Final = 20
_REPEATS: Final = 3
_TIMEOUT: Final = 60.0
_SNAPSHOTS: Final[dict[str, dict[str, object]]] = {
    "all of the agent's state": {},
    "what the web server reads": {"most": 2000},
    "peer list": {"topics": []},
    "topic info": {"topics": ["/module0001/sensors/topic01"], "peers": False},
    "the agent alone": {"topics": [], "peers": False},
}
_CALLS: Final = ("getSystemState", "getTopicTypes")


@dataclass(frozen=True, slots=True)
class View:
    """One question to the agent.

    Args:
        what: Its name.
        bytes: Of the answer.
        cpu_ms: Processor time of the agent, milliseconds; the kernel counts in ticks of 10 ms.
        hold_ms: The longest time without a look at the data path meanwhile, milliseconds of processor time.
    """

    what: str
    bytes: int
    cpu_ms: float
    hold_ms: float


def measure(quick: bool, console: Console, json: Path | None = None) -> dict[str, object]:
    """Measure, print the table, write the file; return the result."""
    peers = 100 if quick else 999
    with tempfile.TemporaryDirectory(prefix="rmpa-views-") as place:
        port = free_port()
        words = [sys.executable, "-m", "lab.bench.views_agent", _NAME, place, str(port), str(peers), str(_TOPICS)]
        environ = {**os.environ, "RMPA_STATE_DIR": f"{place}/state"}
        agent = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=environ, cwd=Path(__file__).parents[2])
        try:
            assert agent.stdout is not None
            ready = agent.stdout.readline()
            joined = msgspec.json.decode(ready.removeprefix("ready "), type=dict[str, float])
            with ControlClient(Path(place) / f"{_NAME}.sock", timeout=_TIMEOUT) as client:
                views = _views(client, agent.pid, port)
                rss = client.agent().rss or 0
        finally:
            agent.terminate()
            agent.wait(_TIMEOUT)
    table = table_of(f"{peers} peers with {_TOPICS} topics", ("question",), ("MB", "agent's CPU, ms", "hold, ms"))
    for view in views:
        table.add_row(view.what, f"{view.bytes / 1e6:.2f}", f"{view.cpu_ms:.0f}", f"{view.hold_ms:.1f}")
    console.print(table)
    worst = max(view.hold_ms for view in views)
    claims = [Claim("the longest hold by a question, ms", worst, 50.0)]
    result: dict[str, object] = {"views": [asdict(view) for view in views], "rss_mb": rss / 1e6, **joined}
    return finish(console, "views", {"peers": peers, "topics": _TOPICS}, result, json, claims=claims)


def _views(client: ControlClient, pid: int, port: int) -> list[View]:
    found = [
        _view(client, pid, what, lambda args=args: len(msgspec.json.encode(client.snapshot(**args))))  # type: ignore[misc]
        for what, args in _SNAPSHOTS.items()
    ]
    return found + [_view(client, pid, f"master's {call}", lambda call=call: _master(port, call)) for call in _CALLS]  # type: ignore[misc]


def _view(client: ControlClient, pid: int, what: str, ask: Callable[[], int]) -> View:
    ask()
    client.call("holds", float)
    began = _cpu(pid)
    size = max(ask() for _ in range(_REPEATS))
    cpu = (_cpu(pid) - began) / _REPEATS
    return View(what, size, round(1e3 * cpu, 1), round(client.call("holds", float), 1))


def _master(port: int, call: str) -> int:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=_TIMEOUT)
    connection.request("POST", "/RPC2", xmlrpc.client.dumps(("/views",), call), {"Content-Type": "text/xml"})
    size = len(connection.getresponse().read())
    connection.close()
    return size


def _cpu(pid: int) -> float:
    """Processor time of a process in seconds."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
