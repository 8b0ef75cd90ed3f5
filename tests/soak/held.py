"""The resources that an agent holds, measured from outside, and whether they grow without a reason."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol

import psutil

from lab.bed.processes import BedError, eventually
from rmpa.core.errors import UnreachableError
from rmpa.observe.control_client import ControlClient

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lab.bed.agents import Agent
    from rmpa.observe.snapshot import Snapshot

MB: Final = 1 << 20
PATIENCE: Final = 60.0
"""Seconds in which an agent answers, however busy the machine is."""
OWN_FAULT: Final = 3.0
"""Seconds by which a loop is later than a thread of its process: then the agent was busy, and not the machine."""
FLOOR_SPAN: Final = 5
"""Samples of which the minimum counts: what a queue or a snapshot held for a moment is no growth."""
GROWTH_MAX: Final = 3 * MB
"""That the floor of the resident memory may rise by in the second half, and by no more than a twentieth: an
allocator's holes are worth a megabyte."""


class Memory(Protocol):
    """A sample of a process's memory: seconds since the soak began, and bytes."""

    @property
    def at(self) -> float:
        """Seconds since the soak began."""

    @property
    def rss(self) -> int:
        """Bytes."""


@dataclass(frozen=True, slots=True)
class Held:
    """One sample of an agent.

    Args:
        at: Seconds since the soak began.
        rss: Resident bytes.
        fds: Open file descriptors, without those of lanes: a bulk lane keeps its own until the link ends.
        sockets: Of these, sockets.
        threads: Of its process.
        tasks: asyncio's, by the name of their coroutine.
        routes: Open ones, both ways.
        proxies: Nodes of peers that stand in its graph.
    """

    at: float
    rss: int
    fds: int
    sockets: int
    threads: int
    tasks: Counter[str]
    routes: int
    proxies: int

    def __str__(self) -> str:
        """For the line of progress."""
        tasks = self.tasks.total()
        return f"{self.rss / MB:.1f} MB, {self.fds} fds ({self.sockets} sockets), {tasks} tasks, {self.routes} routes"


def look(agent: Agent, at: float) -> Held:
    """Take a sample of a running ``stage.WatchedAgent``."""
    process = psutil.Process(agent.pid)
    path = held_path(agent)
    path.unlink(missing_ok=True)
    os.kill(agent.pid, signal.SIGUSR1)
    eventually(path.exists, what=f"what {agent.name} holds", every=0.01)
    snapshot = ask(agent)
    routes = [route for topic in snapshot.topics for route in topic.routes if route.state == "open"]
    links = [peer.link for peer in snapshot.peers if peer.link is not None]
    fds, lanes = _open_files(agent.pid), sum(lane.connected for link in links for lane in link.lanes)
    return Held(
        at=at,
        rss=process.memory_info().rss,
        fds=len(fds) - lanes,
        sockets=sum(name.startswith("socket:") for name in fds) - lanes,
        threads=process.num_threads(),
        tasks=Counter(json.loads(path.read_text(encoding="utf-8"))),
        routes=len(routes),
        proxies=len({(route.peer, route.node) for topic in snapshot.topics for route in topic.routes}),
    )


def ask(agent: Agent) -> Snapshot:
    """An agent's snapshot by its control socket; no process is started for it, which takes seconds on a busy machine.

    An answer that does not come in time is asked for again if the machine was late, and not the agent.

    Raises:
        BedError: The agent was late itself, or the machine for longer than ``PATIENCE``.
    """
    assert agent.runtime_dir
    begin = time.monotonic()
    while True:
        began = time.monotonic()
        try:
            with ControlClient(agent.runtime_dir / f"{agent.name}.sock") as client:
                return client.snapshot()
        except UnreachableError as error:
            late = lateness(agent)
            text = (
                f"{agent.name}: {error} (asked {time.monotonic() - began:.1f} s before; lately its loop was late by "
                f"{late['loop']:.1f} s, a thread beside it by {late['thread']:.1f} s; load {os.getloadavg()[0]:.1f})"
            )
            ours = late["loop"] - late["thread"] > OWN_FAULT
            if ours or time.monotonic() - begin > PATIENCE or agent.process.returncode is not None:
                raise BedError(text) from None
            print(f"         {text}: asked again", flush=True)
            time.sleep(0.5)


def lateness(agent: Agent) -> dict[str, float]:
    """How late an agent's loop, and a thread beside it, have been lately, in seconds; see ``watched``."""
    try:
        found: dict[str, float] = json.loads(held_path(agent).with_suffix(".late").read_text(encoding="utf-8"))
    except OSError:
        found = {"loop": 0.0, "thread": 0.0}
    return found


def _open_files(pid: int) -> list[str]:
    """The target of each file descriptor of a process."""
    found = []
    for entry in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # closed since
            found.append(str(entry.readlink()))
    return found


def held_path(agent: Agent) -> Path:
    """The file into which an agent writes what it holds."""
    return agent.home / f"{agent.name}.held"


def left(before: Held, after: Held) -> list[str]:
    """What an agent still holds though it had to release it; both samples are of an agent without nodes."""
    problems = [
        f"{name}: {was} before, {now} afterwards"
        for name, was, now in (
            ("open files", before.fds, after.fds),
            ("sockets", before.sockets, after.sockets),
            ("routes", before.routes, after.routes),
            ("proxies", before.proxies, after.proxies),
        )
        if now > was
    ]
    more = after.tasks - before.tasks
    return problems + [f"tasks: {count} more of {name}" for name, count in sorted(more.items())]


def floors(samples: Sequence[Memory]) -> list[tuple[float, int]]:
    """Start and least resident memory of each ``FLOOR_SPAN`` samples."""
    spans = [samples[begin : begin + FLOOR_SPAN] for begin in range(0, len(samples), FLOOR_SPAN)]
    return [(span[0].at, min(held.rss for held in span)) for span in spans if len(span) == FLOOR_SPAN]


def slope(points: Sequence[tuple[float, float]]) -> float:
    """The slope of the straight line that fits best (least squares); 0 for fewer than two points."""
    if len(points) < 2:
        return 0.0
    mean_x = sum(x for x, _ in points) / len(points)
    mean_y = sum(y for _, y in points) / len(points)
    square = sum((x - mean_x) ** 2 for x, _ in points)
    return sum((x - mean_x) * (y - mean_y) for x, y in points) / square if square else 0.0


def growth(samples: Sequence[Memory]) -> float | None:
    """Bytes by which the floor of the resident memory rose in the second half; ``None``: too few samples to tell."""
    points = floors(samples[len(samples) // 2 :])
    if len(points) < 3:
        return None
    return slope([(at, float(rss)) for at, rss in points]) * (points[-1][0] - points[0][0])


def too_much(samples: Sequence[Memory], most: float | None = None) -> str:
    """Why the memory is not flat, or an empty string.

    Args:
        samples: Of one process.
        most: Bytes that it may rise by in the second half; else ``GROWTH_MAX`` or a twentieth.
    """
    rose = growth(samples)
    if rose is None or rose <= (min(GROWTH_MAX, samples[-1].rss / 20) if most is None else most):
        return ""
    shown = ", ".join(f"{rss / MB:.1f}" for _, rss in floors(samples))
    return f"memory rose by {rose / MB:.1f} MB in the second half: {shown}"
