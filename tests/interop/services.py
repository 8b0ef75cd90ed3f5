"""Servers and clients of the test's service, in either library, started at a module."""

from __future__ import annotations

from lab.bed.processes import Event, Process, eventually
from tests.interop.modules import Module
from tests.interop.ros import Ros


def worker(module: Module, kind: str = "rospy", service: str = "/work", *, quiet: bool = False) -> Process:
    """Start a server."""
    name = f"worker{service.replace('/', '_')}"
    started = module.ros.node(kind, "worker", name=name, service=service, quiet=quiet)
    started.wait_event("up")
    return started


def caller(module: Module, kind: str = "rospy", service: str = "/work", **options: object) -> Process:
    """Start a client, and wait until the service is there for it."""
    start = module.ros.rospy if kind == "rospy" else module.ros.roscpp
    started = start("caller", service=service, wait=True, commands=True, **options)  # type: ignore[arg-type]
    started.wait_event("there")
    return started


def calls(client: Process, line: str, timeout: float = 20.0) -> Event:
    """Make a client make the calls of its line, and return the outcomes."""
    since = client.mark_events()
    client.tell(line)
    return client.wait_event("done", timeout, since=since)


def wait_services(ros: Ros, *services: str, there: bool = True) -> None:
    """Wait until the stock tools list services, or do not."""

    def seen() -> bool:
        listed = set(ros.tool("rosservice", "list").split())
        return listed >= set(services) if there else not listed & set(services)

    eventually(seen, what=f"{services} {'in' if there else 'out of'} {ros.host.name}")
