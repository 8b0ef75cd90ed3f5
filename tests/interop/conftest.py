"""Fixtures against real ROS and several hosts; see ``ros``, ``namespaces``, ``agents`` and ``processes``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import TYPE_CHECKING

import pytest

from lab.bed import namespaces
from lab.bed.agents import Agent
from lab.bed.namespaces import MACHINE, Host, Lab
from tests.interop.modules import Module
from tests.interop.ros import Ros, free_port

if TYPE_CHECKING:
    from pathlib import Path

    from tests.interop.web import Web

ShellFactory = Callable[..., Ros]
AgentFactory = Callable[..., Agent]
ModuleFactory = Callable[..., list[Module]]
WebFactory = Callable[..., "Web"]


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
            return stack.enter_context(Ros(host, tmp_path, port))

        yield make


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


@pytest.fixture
def modules(lab: Lab, shell: ShellFactory, agent: AgentFactory) -> ModuleFactory:
    """Make linked modules on one network: ``a, b = modules("a", "b")``. Mark the test ``ros`` and ``netns``."""

    def make(*names: str, linked: bool = True, **options: object) -> list[Module]:
        hosts = lab.hosts(*names)
        made = [Module(host, agent(host, name=host.name, **options), shell(host)) for host in hosts]
        for first, one in enumerate(made if linked else []):
            for other in made[first + 1 :]:
                one.agent.wait_peer(other.name)
        return made

    return make


@pytest.fixture
def web() -> Iterator[WebFactory]:
    """Start ``rmpa web`` beside agents of a lab: ``web(agent, "--control")`` returns when it listens."""
    from tests.interop.web import Web

    with ExitStack() as stack:

        def make(agent: Agent, *flags: str, **options: int) -> Web:
            return stack.enter_context(Web(agent, *flags, **options))

        yield make
