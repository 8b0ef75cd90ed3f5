"""Three modules with commands, images and reliable topics between them, and how they are disturbed.

``a`` and ``b`` keep their agents for the whole soak, ``c`` loses its own now and then. Cables are pulled, agents
hang, nodes are killed. Each listener checks what it receives; the errors of a listener that is killed are kept.
"""

from __future__ import annotations

import os
import sys
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

import msgspec

from lab.bed.agents import Agent
from lab.bed.namespaces import Lab
from tests.interop.modules import Module
from tests.interop.ros import Ros
from tests.soak.held import ask, held_path

if TYPE_CHECKING:
    from collections.abc import Callable

    from lab.bed.processes import Process

CONFIG: Final = """
[[contract]]
topics = ["/sure/**"]
reliability = "reliable"
depth = 20000
[[contract]]
topics = ["/command"]
priority = "high"
deadline = 0.5
liveliness = "manual_by_topic"
liveliness_lease_duration = 1
"""
CALM: Final = 40.0
"""Seconds in which all topics must flow again, on a busy machine too."""
RELIABLE_RATE: Final = 200
STEADY: Final = ("a", "b")
_WATCHED: Final = Path(__file__).with_name("watched.py")


class WatchedAgent(Agent):
    """An agent that writes what it holds on SIGUSR1."""

    @property
    def env(self) -> dict[str, str]:
        """The environment, with the file for that."""
        return {**super().env, "SOAK_HELD": str(held_path(self))}

    def peers(self) -> dict[str, dict[str, object]]:
        """The same, by its control socket: see ``held.ask``."""
        return {info.name: msgspec.to_builtins(info) for info in ask(self).peers}

    @property
    def argv(self) -> list[str]:
        """``watched.py`` in place of ``rmpa``."""
        words = super().argv
        at = next(number for number, word in enumerate(words) if word.endswith("/rmpa"))
        return [*words[:at], sys.executable, str(_WATCHED), *words[at + 1 :]]


@dataclass(frozen=True, slots=True)
class Listener:
    """A listener that runs, or is started again.

    Args:
        module: Where.
        topic: What it hears.
        kind: ``roscpp`` or ``rospy``.
    """

    module: str
    topic: str
    kind: str = "roscpp"

    def __str__(self) -> str:
        """As failures name it."""
        return f"{self.kind} listener to {self.topic} at {self.module}"

    @property
    def reliable(self) -> bool:
        """Whether no message may be missing."""
        return self.topic.startswith("/sure/")


@dataclass(frozen=True, slots=True)
class Talker:
    """A talker that runs, or is started again; its numbers begin anew then, under another source.

    Args:
        module: Where.
        topic: What it sends.
        size: Bytes.
        rate: Hz.
    """

    module: str
    topic: str
    size: int
    rate: float

    def __str__(self) -> str:
        """As failures name it."""
        return f"talker of {self.topic} at {self.module}"


TALKERS: Final = (
    Talker("a", "/command", 64, 100),
    Talker("a", "/image", 1 << 20, 4),
    Talker("c", "/chat", 2000, 20),
    Talker("b", "/sure/from_b", 64, RELIABLE_RATE),
    Talker("a", "/sure/from_a", 20_000, 20),
)
LISTENERS: Final = (
    Listener("b", "/command"),
    Listener("c", "/command", "rospy"),
    Listener("b", "/image"),
    Listener("c", "/image"),
    Listener("a", "/chat"),
    Listener("b", "/chat", "rospy"),
    Listener("a", "/sure/from_b"),
    Listener("a", "/sure/from_b", "rospy"),
    Listener("c", "/sure/from_b"),
    Listener("b", "/sure/from_a", "rospy"),
    Listener("c", "/sure/from_a"),
)


class Stage:
    """All processes of the soak.

    Args:
        home: Existing directory for logs.
    """

    def __init__(self, home: Path) -> None:
        self._stack = ExitStack()
        self.home = home
        self.modules: dict[str, Module] = {}
        self.talkers: dict[Talker, Process] = {}
        self.listeners: dict[Listener, Process] = {}
        self.heard = 0
        """Messages of reliable topics, over all listeners that were checked."""
        self._sources: dict[Talker, int] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End everything."""
        self._stack.close()

    def open(self) -> None:
        """Start the modules; return when all are linked."""
        lab = self._stack.enter_context(Lab())
        for host in lab.hosts("a", "b", "c"):
            host.shape("200mbit", bands=True)
            agent = self._stack.enter_context(
                WatchedAgent(host, self.home, name=host.name, config=CONFIG, log_level="info")
            )
            agent.start()
            agent.wait_ready()
            shell = self._stack.enter_context(Ros(host, self.home, 11311))
            self.modules[host.name] = Module(host, agent, shell)
        self.wait_linked()

    def wait_linked(self) -> None:
        """Wait until each agent is linked with each other one."""
        for module in self.modules.values():
            for other in self.modules:
                if other != module.name:
                    module.agent.wait_peer(other, CALM)

    # --- nodes --------------------------------------------------------------------------------------------------

    def populate(self, only: str = "") -> None:
        """Start the nodes, all or those of one module."""
        for listener in LISTENERS:
            if only in ("", listener.module):
                self.listen(listener)
        for talker in TALKERS:
            if only in ("", talker.module):
                self.talk(talker)

    def talk(self, talker: Talker) -> None:
        """Start a talker, in place of the one before."""
        self._sources[talker] = max(self._sources.values(), default=0) + 1
        ros = self.modules[talker.module].ros
        self.talkers[talker] = ros.roscpp(
            "talker",
            topic=talker.topic,
            size=talker.size,
            rate=talker.rate,
            source=self._sources[talker],
            nodelay=True,
        )

    def listen(self, listener: Listener) -> None:
        """Start a listener, in place of the one before."""
        self.listeners[listener] = self.modules[listener.module].ros.node(
            listener.kind, "listener", topic=listener.topic, nodelay=True
        )

    def depopulate(self, only: str = "") -> list[str]:
        """End the nodes, all or those of one module; return what was wrong with what the listeners heard."""
        problems = []
        for listener in [listener for listener in self.listeners if only in ("", listener.module)]:
            problems += self.kill_listener(listener)
        for talker in [talker for talker in self.talkers if only in ("", talker.module)]:
            self.talkers.pop(talker).end()
        return problems

    def kill_listener(self, listener: Listener) -> list[str]:
        """Kill a listener; return the errors in what it received."""
        process = self.listeners.pop(listener)
        process.kill()
        problems = self.errors_of(listener, process)
        reports = process.events("report")
        if listener.reliable and reports:
            self.heard += int(str(reports[-1]["count"]))
        return problems

    def restart_talker(self, talker: Talker) -> None:
        """Kill a talker and start it again."""
        self.talkers.pop(talker).kill()
        self.talk(talker)

    def errors_of(self, listener: Listener, process: Process) -> list[str]:
        """The errors in what a listener has received so far."""
        reports = process.events("report")
        if not reports:
            return []
        words = ("bad", "doubled", "gaps") if listener.reliable else ("bad", "doubled")
        return [f"{listener}: {reports[-1][word]} {word}: {reports[-1]}" for word in words if reports[-1][word]]

    def all_errors(self) -> list[str]:
        """The same for all listeners."""
        return [text for listener, process in self.listeners.items() for text in self.errors_of(listener, process)]

    # --- disturbances -------------------------------------------------------------------------------------------

    def restart(self, name: str, end: Callable[[Agent], object]) -> list[str]:
        """End an agent and start it again, with its module's nodes, which the new core does not know."""
        agent = self.modules[name].agent
        end(agent)
        problems = self.depopulate(name)
        agent.restart()
        self.populate(name)
        return problems

    def settle(self) -> list[str]:
        """Wait until all are linked and each listener receives; return what stays silent, or was wrong."""
        self.wait_linked()
        counts = {listener: _count(process) for listener, process in self.listeners.items()}
        deadline = time.monotonic() + CALM
        while waiting := [
            listener for listener, process in self.listeners.items() if _count(process) <= counts[listener] + 2
        ]:
            if time.monotonic() > deadline:
                return [f"{listener}: silent for {CALM:g} s" for listener in waiting]
            time.sleep(0.05)
        return self.all_errors()

    def drain(self) -> list[str]:
        """Stop the talkers of reliable topics; return which listeners do not all get the same last message."""
        problems = []
        for talker in [talker for talker in self.talkers if talker.topic.startswith("/sure/")]:
            process = self.talkers.pop(talker)
            process.freeze()  # ending it would lose what is still in flight
            deadline = time.monotonic() + CALM
            while len(lasts := self._lasts(talker)) > 1 and time.monotonic() < deadline:
                time.sleep(0.1)
            if len(lasts) > 1:
                problems.append(f"{talker} has stopped, and its listeners have messages up to {sorted(lasts)}")
            process.end()
        return problems

    def _lasts(self, talker: Talker) -> set[int]:
        """The last messages of a talker, as its listeners have them."""
        heard = [process for listener, process in self.listeners.items() if listener.topic == talker.topic]
        source = str(self._sources[talker])
        return {process.events("report")[-1]["sources"][source]["last"] for process in heard}  # type: ignore[index]


def _count(process: Process) -> int:
    reports = process.events("report")
    return int(str(reports[-1]["count"])) if reports else 0


def leftovers() -> list[str]:
    """Network namespaces of this process that are still there."""
    return [path.name for path in Path("/run/netns").glob(f"rmpa-{os.getpid()}-*")]
