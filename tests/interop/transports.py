"""By which connections the nodes of a test exchange messages, as the kernel's tables of their hosts say."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Collection, Iterable
from typing import Final

from lab.bed.processes import DEADLINE, Deadline, Event, Process, eventually
from rmpa.core.facts import SubscriberTransport
from rmpa.observe.control_client import ControlClient
from tests.interop.modules import Module, flows
from tests.interop.ros import PYTHON

AUTO: Final = '[bridge]\ntransport = "auto"\n'
_BUS_INFO: Final = """
import json, sys, xmlrpc.client
master, node = sys.argv[1:]
uri = xmlrpc.client.ServerProxy(master).lookupNode("/test", node)[2]
print(json.dumps(xmlrpc.client.ServerProxy(uri).getBusInfo("/test")[2]))
"""
RELAY: Final = '[[contract]]\ntopics = ["/chatter"]\ntransport = "relay"\n'


def reload(module: Module, text: str) -> None:
    """Give an agent other settings."""
    (module.agent.home / f"{module.name}.toml").write_text(text, encoding="utf-8")
    code, said = module.agent.rmpa("reload")
    assert code == 0, said


def on_the_network(*modules: Module) -> None:
    """Let the nodes that are started from now on listen for the network, not for loopback only."""
    for module in modules:
        module.ros.env["ROS_IP"] = module.host.address


def connections(process: Process) -> set[tuple[str, str]]:
    """The established TCP connections of a process: the own and the other end of each, as ``address:port``."""
    if process.returncode is not None:
        return set()
    command = ["nsenter", "-t", str(process.pid), "-n", "ss", "-tnpHO", "state", "established"]
    table = subprocess.run(command, capture_output=True, text=True, check=False, timeout=20).stdout
    rows = (line.split() for line in table.splitlines() if f"pid={process.pid}," in line)
    return {(_ipv4(row[2]), _ipv4(row[3])) for row in rows}


def _ipv4(endpoint: str) -> str:
    return endpoint.replace("[::ffff:", "").replace("]", "")


def links(subscriber: Process, publisher: Process) -> int:
    """The number of connections between two nodes; 0 if every message between them goes through the agents."""
    there = connections(publisher)
    return sum((other, own) in there for own, other in connections(subscriber))


def direct_topics(module: Module, node: str, other: Module) -> set[str]:
    """The topics that a node gets from nodes on another module's host, as the node itself says."""
    rows = json.loads(module.ros.tool(PYTHON, "-c", _BUS_INFO, module.ros.uri, node))
    inbound = [row for row in rows if row[2] == "i" and f"[{other.host.address}:" in str(row[6:])]
    assert len(inbound) == len({row[4] for row in inbound}), inbound
    return {row[4] for row in inbound}


def conditions(module: Module) -> dict[str, str]:
    """Why subscribers of the topics that come from peers are relayed, by topic; empty where none is."""
    with ControlClient(module.agent.sockets()[0]) as client:
        topics = client.snapshot().topics
    return {
        topic.name: route.condition
        for topic in topics
        for route in topic.routes
        if route.direction == "in" and (route.transport or route.condition)
    }


def shown(module: Module, topic: str, node: str) -> SubscriberTransport | None:
    """What a module says of one subscriber of a topic that comes from one peer; ``None`` if it does not name it."""
    with ControlClient(module.agent.sockets()[0]) as client:
        topics = client.snapshot().topics
    rows = [one for info in topics if info.name == topic for route in info.routes for one in route.subscribers]
    return next((one for one in rows if one.node == node), None)


def wait_condition(module: Module, topic: str, condition: str) -> None:
    """Wait until a module says that a topic is relayed because of one condition of docs/guides/contracts.md."""
    eventually(lambda: conditions(module).get(topic) == condition, what=f"{topic} relayed by {condition}")


def wait_direct_topics(module: Module, node: str, other: Module, topics: Collection[str]) -> None:
    """Wait until a node gets exactly these topics from nodes on another module's host."""
    found: set[str] = set()

    def as_wanted() -> bool:
        found.clear()
        found.update(direct_topics(module, node, other))
        return found == set(topics)

    try:
        eventually(as_wanted)
    except Deadline as error:
        text = f"{node} of {module.name}: direct are {sorted(found)}, not {sorted(topics)}"
        raise AssertionError(text) from error


def wait_direct(subscriber: Process, publisher: Process, timeout: float = DEADLINE) -> Event:
    """Wait until a node is connected to another one, once, and hears it; return its report."""
    what = f"{subscriber.name} connected to {publisher.name}"
    eventually(lambda: links(subscriber, publisher) == 1, timeout, what=what)
    return flows(subscriber)


def wait_relayed(subscriber: Process, publisher: Process, timeout: float = DEADLINE) -> Event:
    """Wait until a node is not connected to another one any more, but hears it; return its report."""
    what = f"{subscriber.name} not connected to {publisher.name}"
    eventually(lambda: links(subscriber, publisher) == 0, timeout, what=what)
    return flows(subscriber)


def in_order(report: Event) -> None:
    """Fail unless a report says: each byte right, none doubled or moved (gaps are allowed)."""
    assert (report["bad"], report["doubled"]) == (0, 0), report


def unbroken(report: Event, before: Event | None = None) -> None:
    """Fail unless a report says: each byte right, none doubled, moved, or missing since the first or ``before``."""
    assert (report["bad"], report["doubled"], report["gaps"]) == (0, 0, before["gaps"] if before else 0), report


def heard(listener: Process, topics: Iterable[str], more: int = 10) -> dict[str, Event]:
    """Wait until a listener of many topics has received so many further messages of each; return their reports."""
    wanted = dict.fromkeys(topics, more)
    for topic, report in _last(listener).items():
        if topic in wanted:
            wanted[topic] += int(str(report["count"]))

    def enough(event: Event) -> bool:
        rows = event["topics"]
        assert isinstance(rows, dict)
        return all(topic in rows and rows[topic]["count"] >= count for topic, count in wanted.items())

    rows = listener.wait_event("report", where=enough, since=listener.mark_events())["topics"]
    assert isinstance(rows, dict)
    return rows


def steady(listener: Process, topics: Iterable[str]) -> dict[str, Event]:
    """Fail unless messages of all topics come one by one from now on, and each came in order before."""
    begin, end = heard(listener, topics), heard(listener, topics, 25)
    for topic in topics:
        in_order(end[topic])
        assert end[topic]["gaps"] == begin[topic]["gaps"], topic
    return end


def _last(listener: Process) -> dict[str, Event]:
    reports = listener.events("report")
    rows = reports[-1]["topics"] if reports else {}
    assert isinstance(rows, dict)
    return rows
