"""The test bed of one run: temporary directory, hosts, masters and agents that end with it."""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Final

from lab.bed import namespaces, ros, transport
from lab.bed.agents import Agent
from lab.bed.namespaces import MACHINE, Host, Lab
from lab.bed.processes import Closing
from lab.bed.ros import Ros, free_port

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lab.bed.plan import Transport

# Nodes of the tests of which some are measured as well.
TEST_NODES: Final = Path(__file__).parents[2] / "tests" / "interop" / "nodes"


class Bed(Closing):
    """What measurements start, and what ends with ``close``."""

    def __init__(self) -> None:
        self._stack = ExitStack()
        self.home = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="rmpa-bench-")))
        self._lab: Lab | None = None

    @property
    def lab(self) -> Lab:
        """Hosts and networks."""
        if self._lab is None:
            self._lab = self._stack.enter_context(Lab())
        return self._lab

    def shell(self, host: Host = MACHINE, port: int = 0) -> Ros:
        """A ROS user's shell; its nodes can be reached at their host's address."""
        port = port or (11311 if host.namespace else free_port())
        made = self._stack.enter_context(Ros(host, self.home, port))
        made.env["ROS_IP"] = host.address
        return made

    def classic(self, network: int = 0, name: str = "classic") -> tuple[Ros, Ros]:
        """Two shells as classic ROS has them: on two hosts of one network, with one rosmaster, on the first."""
        a, b = self.lab.hosts(f"{name}_a", f"{name}_b", network=network)
        here, there = self.shell(a), self.shell(b)
        here.env["ROS_MASTER_URI"] = there.env["ROS_MASTER_URI"] = f"http://{a.address}:{here.port}"
        here.master()
        return here, there

    def agent(
        self,
        host: Host = MACHINE,
        *,
        name: str = "",
        start: bool = True,
        multicast: str = "",
        flags: Sequence[str] = (),
        way: Transport = "relay",
        config: str = "",
    ) -> Agent:
        """An agent as users run it; ready when this returns, unless ``start`` is false.

        ``way`` is the transport of what no contract in ``config`` gives another one; the rest is as of ``Agent``.
        """
        config += transport.settings(way)
        made = Agent(host, self.home, name=name, log_level="warning", multicast=multicast, flags=flags, config=config)
        agent = self._stack.enter_context(made)
        if start:
            agent.start()
            agent.wait_ready()
        return agent

    def close(self) -> None:
        """End everything."""
        self._stack.close()


def why_no_ros() -> str:
    """Why real ROS nodes cannot be measured here, or an empty string."""
    return ros.why_not()


def why_no_hosts() -> str:
    """Why network namespaces cannot be used here, or an empty string."""
    return namespaces.why_not()
