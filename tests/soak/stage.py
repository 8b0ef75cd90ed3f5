"""Three modules with commands, images and reliable topics among them, and what can befall them.

``a`` and ``b`` keep their agents for the whole soak, ``c`` loses its own now and then. Cables are pulled, agents
hang, nodes are killed. Each listener checks what it hears; a listener that is killed has its account kept.
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
"""Seconds in which everything must flow again, on a busy machine too."""
RELIABLE_RATE: Final = 200
STEADY: Final = ("a", "b")
_WATCHED: Final = Path(__file__).with_name("watched.py")


class WatchedAgent(Agent):
    """An agent that can be asked what it holds."""

    @property
    def env(self) -> dict[str, str]:
        """With the file for that."""
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
class Ear:
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
        """Whether nothing may be missing."""
        return self.topic.startswith("/sure/")


@dataclass(frozen=True, slots=True)
class Mouth:
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


MOUTHS: Final = (
    Mouth("a", "/command", 64, 100),
    Mouth("a", "/image", 1 << 20, 4),
    Mouth("c", "/chat", 2000, 20),
    Mouth("b", "/sure/from_b", 64, RELIABLE_RATE),
    Mouth("a", "/sure/from_a", 20_000, 20),
)
EARS: Final = (
    Ear("b", "/command"),
    Ear("c", "/command", "rospy"),
    Ear("b", "/image"),
    Ear("c", "/image"),
    Ear("a", "/chat"),
    Ear("b", "/chat", "rospy"),
    Ear("a", "/sure/from_b"),
    Ear("a", "/sure/from_b", "rospy"),
    Ear("c", "/sure/from_b"),
    Ear("b", "/sure/from_a", "rospy"),
    Ear("c", "/sure/from_a"),
)


class Stage:
    """Everything that runs.

    Args:
        home: Existing directory for logs.
    """

    def __init__(self, home: Path) -> None:
        self._stack = ExitStack()
        self.home = home
        self.modules: dict[str, Module] = {}
        self.talking: dict[Mouth, Process] = {}
        self.listening: dict[Ear, Process] = {}
        self.heard = 0
        """Messages of reliable topics, over all listeners that were checked."""
        self._sources: dict[Mouth, int] = {}

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
        for ear in EARS:
            if only in ("", ear.module):
                self.listen(ear)
        for mouth in MOUTHS:
            if only in ("", mouth.module):
                self.talk(mouth)

    def talk(self, mouth: Mouth) -> None:
        """Start a talker, in place of the one before."""
        self._sources[mouth] = max(self._sources.values(), default=0) + 1
        ros = self.modules[mouth.module].ros
        self.talking[mouth] = ros.roscpp(
            "talker", topic=mouth.topic, size=mouth.size, rate=mouth.rate, source=self._sources[mouth], nodelay=True
        )

    def listen(self, ear: Ear) -> None:
        """Start a listener, in place of the one before."""
        self.listening[ear] = self.modules[ear.module].ros.node(ear.kind, "listener", topic=ear.topic, nodelay=True)

    def depopulate(self, only: str = "") -> list[str]:
        """End the nodes, all or those of one module; return what was wrong with what the listeners heard."""
        problems = []
        for ear in [ear for ear in self.listening if only in ("", ear.module)]:
            problems += self.silence(ear)
        for mouth in [mouth for mouth in self.talking if only in ("", mouth.module)]:
            self.talking.pop(mouth).end()
        return problems

    def silence(self, ear: Ear) -> list[str]:
        """Kill a listener; return what was wrong with what it heard."""
        process = self.listening.pop(ear)
        process.kill()
        problems = self.account(ear, process)
        reports = process.events("report")
        if ear.reliable and reports:
            self.heard += int(str(reports[-1]["count"]))
        return problems

    def hang_up(self, mouth: Mouth) -> None:
        """Kill a talker and start it again."""
        self.talking.pop(mouth).kill()
        self.talk(mouth)

    def account(self, ear: Ear, process: Process) -> list[str]:
        """What was wrong with what a listener has heard so far."""
        reports = process.events("report")
        if not reports:
            return []
        words = ("bad", "doubled", "gaps") if ear.reliable else ("bad", "doubled")
        return [f"{ear}: {reports[-1][word]} {word}: {reports[-1]}" for word in words if reports[-1][word]]

    def accounts(self) -> list[str]:
        """The same for all that listen."""
        return [text for ear, process in self.listening.items() for text in self.account(ear, process)]

    # --- what befalls them --------------------------------------------------------------------------------------

    def restart(self, name: str, end: Callable[[Agent], object]) -> list[str]:
        """End an agent and start it again, and its module's nodes: a core that is new knows none of them."""
        agent = self.modules[name].agent
        end(agent)
        problems = self.depopulate(name)
        agent.restart()
        self.populate(name)
        return problems

    def settle(self) -> list[str]:
        """Wait until all are linked and every listener hears; return what does not come back, or was wrong."""
        self.wait_linked()
        counts = {ear: _count(process) for ear, process in self.listening.items()}
        deadline = time.monotonic() + CALM
        while waiting := [ear for ear, process in self.listening.items() if _count(process) <= counts[ear] + 2]:
            if time.monotonic() > deadline:
                return [f"{ear}: silent for {CALM:g} s" for ear in waiting]
            time.sleep(0.05)
        return self.accounts()

    def drain(self) -> list[str]:
        """Stop the talkers of reliable topics; return which listeners do not all get the same last message."""
        problems = []
        for mouth in [mouth for mouth in self.talking if mouth.topic.startswith("/sure/")]:
            process = self.talking.pop(mouth)
            process.freeze()  # whoever ends takes with it what is still under way
            deadline = time.monotonic() + CALM
            while len(lasts := self._lasts(mouth)) > 1 and time.monotonic() < deadline:
                time.sleep(0.1)
            if len(lasts) > 1:
                problems.append(f"{mouth} has stopped, and its listeners have messages up to {sorted(lasts)}")
            process.end()
        return problems

    def _lasts(self, mouth: Mouth) -> set[int]:
        """The last messages of a talker, as its listeners have them."""
        heard = [process for ear, process in self.listening.items() if ear.topic == mouth.topic]
        source = str(self._sources[mouth])
        return {process.events("report")[-1]["sources"][source]["last"] for process in heard}  # type: ignore[index]


def _count(process: Process) -> int:
    reports = process.events("report")
    return int(str(reports[-1]["count"])) if reports else 0


def leftovers() -> list[str]:
    """Network namespaces of this process that are still there."""
    return [path.name for path in Path("/run/netns").glob(f"rmpa-{os.getpid()}-*")]
