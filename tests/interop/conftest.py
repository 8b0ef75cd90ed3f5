"""Fixtures against real ROS and several hosts; see ``ros``, ``namespaces``, ``agents`` and ``processes``."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, Final

import pytest

from lab.bed import namespaces, processes
from lab.bed.agents import Agent
from lab.bed.namespaces import MACHINE, Host, Lab
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.environment import RosEnvironment
from rmpa.ros.node.node import Node
from tests.interop import forks
from tests.interop.modules import Bed, Module, start_linked
from tests.interop.ros import Ros, free_port

if TYPE_CHECKING:
    from pathlib import Path

    from tests.interop.web import Web

ShellFactory = Callable[..., Ros]
AgentFactory = Callable[..., Agent]
ModuleFactory = Callable[..., list[Module]]
WebFactory = Callable[..., "Web"]
# Beds that are kept for the next test; agents at rest cost little.
_BEDS: Final = 3


@pytest.fixture(autouse=True, scope="package")
def _quick_starts() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(processes, "spawn", forks.popen)
        yield


@pytest.fixture(scope="session")
def _no_stale_namespaces() -> None:
    namespaces.remove_stale()


@pytest.fixture
def lab(_no_stale_namespaces: None) -> Iterator[Lab]:
    """An empty set of hosts and networks, gone after the test. Mark the test ``netns``."""
    with Lab() as made:
        yield made


@pytest.fixture
def shell(tmp_path: Path) -> Iterator[ShellFactory]:
    """Make ROS users' shells: ``shell(host)`` or, on the real machine, ``shell(port=...)``. Mark the test ``ros``."""
    with ExitStack() as stack:

        def make(host: Host = MACHINE, port: int = 0) -> Ros:
            port = port or (11311 if host.namespace else free_port())
            stack.callback((made := Ros(host, tmp_path, port)).close, orderly=False)
            return made

        yield make


@pytest.fixture
async def core() -> AsyncIterator[RosCore]:
    """Our core on a free port."""
    made = RosCore("127.0.0.1", 0)
    await made.start()
    yield made
    await made.close()


@pytest.fixture
async def ros(core: RosCore, shell: ShellFactory) -> AsyncIterator[Ros]:
    """A shell at our core. Its nodes may wait for the core as they end: that has its turn meanwhile."""
    made = shell(port=core.port)
    yield made
    await asyncio.to_thread(made.close)


@pytest.fixture
async def node(core: RosCore) -> AsyncIterator[Node]:
    """A node of ours at our core."""
    async with Node("ours", master_uri=core.uri, environment=RosEnvironment()) as made:
        yield made


def framed(payload: bytes) -> bytes:
    """A std_msgs/UInt8MultiArray as raw bytes: no dimensions, offset 0."""
    return bytes(8) + struct.pack("<I", len(payload)) + payload


@pytest.fixture
def agent(tmp_path: Path) -> Iterator[AgentFactory]:
    """Start agents: ``agent(host, name="base")`` returns when it is ready; options as of ``Agent``."""
    with ExitStack() as stack:

        def make(host: Host = MACHINE, *, ready: bool = True, **options: object) -> Agent:
            made = stack.enter_context(Agent(host, tmp_path, **options))  # type: ignore[arg-type]
            made.start()
            if ready:
                made.wait_ready()
            return made

        yield make


class Beds:
    """The beds that tests left as they were: some of the latest."""

    def __init__(self, home: Path) -> None:
        self._home = home
        self._beds: dict[str, Bed] = {}
        self._made = 0

    def take(self, names: tuple[str, ...], options: dict[str, object]) -> tuple[str, Bed]:
        """A bed of such modules, one that is there or a new one, and its key for ``give_back``."""
        key = repr((names, sorted(options.items())))
        if (bed := self._beds.pop(key, None)) is not None:
            return key, bed
        self._made += 1
        (home := self._home / str(self._made)).mkdir()
        return key, Bed(home, names, options)

    def give_back(self, key: str, bed: Bed) -> None:
        """Keep a bed for others if its test left it as it was."""
        if not bed.settled():
            bed.close()
            return
        self._beds[key] = bed
        while len(self._beds) > _BEDS:
            self._beds.pop(next(iter(self._beds))).close()

    def close(self) -> None:
        """End them all."""
        while self._beds:
            self._beds.popitem()[1].close()


@pytest.fixture(scope="session")
def beds(_no_stale_namespaces: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Beds]:
    """Beds that tests share."""
    made = Beds(tmp_path_factory.mktemp("beds"))
    yield made
    made.close()


@pytest.fixture
def modules(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[ModuleFactory]:
    """Make linked modules on one network: ``a, b = modules("a", "b")``. Mark the test ``ros`` and ``netns``.

    They may have served an earlier test that left them as they were; but they are new where a test takes the fixture
    ``lab``, to add to it, and with ``fresh``.
    """
    own_lab = "lab" in request.fixturenames
    with ExitStack() as stack:

        def make(*names: str, linked: bool = True, fresh: bool = False, **options: object) -> list[Module]:
            if own_lab or fresh or not linked:
                hosts = request.getfixturevalue("lab").hosts(*names)
                agents = start_linked(hosts, tmp_path, stack, options, linked=linked)
            else:
                beds = request.getfixturevalue("beds")
                key, bed = beds.take(names, options)
                stack.callback(beds.give_back, key, bed)
                agents = bed.agents
            shells = [Ros(agent.host, tmp_path, agent.core_port) for agent in agents]
            for ros in shells:
                stack.callback(ros.close, orderly=not own_lab and not fresh and linked)
            return [Module(agent.host, agent, ros) for agent, ros in zip(agents, shells, strict=True)]

        yield make


@pytest.fixture
def web() -> Iterator[WebFactory]:
    """Start ``rmpa web`` beside agents of a lab: ``web(agent, "--control")`` returns when it listens."""
    from tests.interop.web import Web

    with ExitStack() as stack:

        def make(agent: Agent, *flags: str, **options: Any) -> Web:
            return stack.enter_context(Web(agent, *flags, **options))

        yield make
