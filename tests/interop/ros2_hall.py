"""A module beside a gateway that is a Zenoh router, and a host with programs of other worlds."""

from __future__ import annotations

import json
import sys
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from lab.bed.agents import Agent
from lab.bed.gateways import ROUTER_PORT, GatewayProcess, python_of
from lab.bed.namespaces import Host, Lab
from lab.bed.processes import Event, Process
from lab.bed.ros import NODES as LAB_NODES
from tests.interop.modules import Module
from tests.interop.ros import NODES, Ros

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence


LONG: Final = 30.0
CONFIG: Final = f"""
[gateway]
site = "hall"
router = true
listen = ["tcp/0.0.0.0:{ROUTER_PORT}"]
insecure = true

[gateway.ros2]
enabled = true
"""
RCLPY: Final = """
[gateway.ros2]
enabled = true
python = "{python}"
"""
# The workspace of ROS 1 at the gateway: it has an action that ROS 2's test_msgs has too.
SOURCED: Final = ("env", f"ROS_PACKAGE_PATH={NODES.parent / 'packages'}")
# ROS 2 as ``zenoh-ros2-sdk`` speaks it; else ``rclpy`` of the distribution that is named.
ZENOH: Final = "zenoh"


@dataclass(frozen=True, slots=True)
class OtherEnd:
    """A program of another world that does what lines of JSON say."""

    process: Process

    def do(self, what: str, **words: object) -> None:
        """Let it do something; return when it is done."""
        since = self.process.mark_events()
        self.process.tell(json.dumps({"do": what, **words}))
        self.process.wait_event("done", LONG, since=since)

    def ask(self, what: str, event: str, **words: object) -> Event:
        """Let it do something; return the event that it says of it."""
        since = self.process.mark_events()
        self.do(what, **words)
        return self.process.wait_event(event, since=since)


@dataclass(frozen=True, slots=True)
class Hall:
    """One module, its gateway, and a host for the other ends."""

    robot: Module
    gateway: GatewayProcess
    other: Host
    home: Path
    stack: ExitStack
    way: str = ZENOH
    more: tuple[Module, ...] = ()

    def node(self, name: str, *words: str) -> OtherEnd:
        """Start a ROS 2 node on the other host."""
        if self.way == ZENOH:
            return self.end("ros2_end", self.robot.host.address)
        return self.end("rclpy_end", name, *words, python=python_of(self.way))

    def relay(self, *topics: str) -> None:
        """Start a ROS 2 node that publishes the bytes that it hears on a topic on another one."""
        self.end("rclpy_node", "relay", *topics, python=python_of(self.way), folder=LAB_NODES)

    def end(self, program: str, *words: str, python: Path = Path(sys.executable), folder: Path = NODES) -> OtherEnd:
        """Start a program of ``nodes/`` on the other host."""
        env = {"PATH": "/usr/bin:/bin", "HOME": str(self.home), "PYTHONPATH": f"{NODES}:{LAB_NODES}"}
        argv = self.other.command([python, folder / f"{program}.py", *words])
        process = self.stack.enter_context(Process(argv, env=env, name=program, commands=True))
        process.wait_event("up", LONG)
        return OtherEnd(process)


@contextmanager
def running_hall(
    home: Path, config: str = "", *, way: str = ZENOH, gateway_config: str = "", more: Sequence[str] = ()
) -> Iterator[Hall]:
    """Start the module and its gateway, and join them.

    Args:
        home: Existing directory.
        config: Text of the module's ``rmpa.toml``.
        way: To ROS 2.
        gateway_config: More text of the gateway's.
        more: Names of further modules, each on a host of its own.
    """
    text = CONFIG if way == ZENOH else RCLPY.format(python=python_of(way))
    with ExitStack() as stack:
        lab = stack.enter_context(Lab())
        *hosts, other = lab.hosts("robot", *more, "other")
        agents = [stack.enter_context(Agent(host, home, name=host.name, config=config)) for host in hosts]
        gateway = stack.enter_context(
            GatewayProcess(hosts[0], home, name="gate", config=text + gateway_config, prefix=SOURCED)
        )
        for one in (*agents, gateway):
            one.start()
        for one in (*agents, gateway):
            one.wait_ready()
        modules = []
        for agent in agents:
            agent.wait_peer(gateway.name)
            modules.append(Module(agent.host, agent, stack.enter_context(Ros(agent.host, home, 11311))))
        yield Hall(modules[0], gateway, other, home, stack, way, tuple(modules[1:]))
