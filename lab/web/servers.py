"""The web servers that are measured, each with a publisher of its own.

Only the one whose turn it is has anything to do.

``rmpa web`` and foxglove-sdk's server are beside one agent, whose core they share.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from lab.bed.agents import RMPA, Agent
from lab.bed.processes import Process
from lab.bed.ros import NODES, Ros, free_port

if TYPE_CHECKING:
    from lab.bed.bench import Bed
    from lab.web.subscriptions import How

_ROOT: Final = Path(__file__).parents[2]
# Of the publisher, messages for each subscriber.
_QUEUE: Final = 8
_URL_WITHIN: Final = 30.0


@dataclass(frozen=True, slots=True)
class WebServer:
    """One server, and a publisher that it serves.

    Args:
        key: For results.
        title: For tables.
        port: On this machine.
        path: With the token, where it asks for one.
        hows: The protocols and encodings that it has.
        process: Its process.
        ros: A shell with its master.
        source: Publishes ``topic``, as ``lab/nodes/source.cpp`` has it.
        topic: What its clients subscribe to.
    """

    key: str
    title: str
    port: int
    path: str
    hows: tuple[How, ...]
    process: Process
    ros: Ros
    source: Process
    topic: str

    def readers(self, how: How, count: int, stalled: int = 0) -> Process:
        """Start clients (``lab/web/reader.py``), which have subscribed when this returns; the caller ends them."""
        words = ["--port", str(self.port), "--path", self.path, "--how", how, "--topic", self.topic]
        words += ["--count", str(count), "--stalled", str(stalled)]
        return program("lab.web.reader", *words)


def program(module: str, *words: str) -> Process:
    """Start a program of ``lab`` in this interpreter's environment, and wait until it is up."""
    env = {**os.environ, "PYTHONPATH": str(_ROOT), "PYTHONUNBUFFERED": "1"}
    name = module.rpartition(".")[2]
    process = Process([sys.executable, "-m", module, *words], env=env, name=name, commands=True)
    try:
        process.wait_event("up")
    except BaseException:
        process.end()
        raise
    return process


def why_no_web() -> str:
    """Why ``rmpa web`` cannot be measured here, or an empty string."""
    if importlib.util.find_spec("aiohttp") is None:
        return "the libraries of rmpa web are not installed (pip install -c constraints.txt -e '.[web]')"
    return ""


def why_no_sdk() -> str:
    """Why foxglove-sdk cannot be measured here, or an empty string."""
    if importlib.util.find_spec("foxglove") is None:
        return "foxglove-sdk is not installed (pip install -c constraints.txt -e '.[web-peers]')"
    return ""


def rmpa_web(bed: Bed, agent: Agent, *, control: bool = True, runtime_dir: Path | None = None) -> tuple[Process, int]:
    """Start ``rmpa web`` beside an agent; returns it with its port when it serves.

    Args:
        bed: Ends it.
        agent: Its agent.
        control: Whether its clients, who then need the token ``token_of`` gives, may call services.
        runtime_dir: Where it finds the agent's control socket, if not in the agent's own directory.
    """
    port = free_port()
    words = ["web", "--port", str(port)]
    if control:
        words += ["--control", "--token-file", str(bed.home / "web-token")]
    env = {**agent.env, **({"RMPA_RUNTIME_DIR": str(runtime_dir)} if runtime_dir else {"RMPA_AGENT": agent.name})}
    process = bed.shell(port=agent.core_port).start(RMPA, *words, name="rmpa web", env=env)
    process.wait_for(r"^http://", _URL_WITHIN)
    return process, port


def token_of(bed: Bed) -> str:
    """The token of ``rmpa web`` with ``control``."""
    return (bed.home / "web-token").read_text(encoding="ascii").strip()


def start_rmpa(bed: Bed, agent: Agent) -> WebServer:
    """``rmpa web`` with a publisher."""
    process, port = rmpa_web(bed, agent)
    ros = bed.shell(port=agent.core_port)
    topic = "/for_rmpa"
    hows: tuple[How, ...] = ("cbor-raw", "cbor", "json", "foxglove")
    path = f"/?token={token_of(bed)}"
    return WebServer("rmpa", "rmpa web", port, path, hows, process, ros, _source(ros, topic), topic)


def start_sdk(bed: Bed, agent: Agent) -> WebServer:
    """foxglove-sdk's server, fed by our own client at the agent's core, with a publisher."""
    ros, port, topic = bed.shell(port=agent.core_port), free_port(), "/for_sdk"
    words = ["--topic", topic, "--port", str(port)]
    process = ros.start(sys.executable, NODES / "foxglove_server.py", *words, name="foxglove-sdk")
    process.wait_event("up")
    return WebServer("sdk", "foxglove-sdk", port, "/", ("foxglove",), process, ros, _source(ros, topic), topic)


def _source(ros: Ros, topic: str) -> Process:
    name = f"{topic.strip('/')}_source"
    source = ros.roscpp("source", name=name, topic=topic, queue=_QUEUE, commands=True)
    source.wait_event("up")
    return source
