"""Which ROS master a topic command asks, and what its graph holds.

In this order: ``--master``; the core of the agent named by ``--agent`` or RMPA_AGENT; ROS_MASTER_URI, as the stock
tools have it; the core of the only agent of this machine; ``http://localhost:11311``.
"""

from __future__ import annotations

import contextlib
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from rmpa.bridge.proxy_names import proxied_node
from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError, RmpaError, UnreachableError
from rmpa.core.names import is_legal_name
from rmpa.observe.io.control_client import ControlClient, choose_agent, find_agents, same_core
from rmpa.ros.environment import DEFAULT_MASTER_URI

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from rmpa.observe.snapshot import Snapshot

_REMEDY: Final = "start one with `rmpa up` or `rmpa core`, or name it with --master"


@dataclass(frozen=True, slots=True)
class Master:
    """The master to ask.

    Args:
        uri: Its address.
        source: How it was chosen, for the text of errors.
        agent: The control socket of its agent, if it is an agent's core.
    """

    uri: str
    source: str
    agent: Path | None = None

    def unreachable(self) -> UnreachableError:
        """The error for when nobody answers."""
        return UnreachableError("ROS master", f"{self.uri} ({self.source})", _REMEDY)

    def snapshot(self) -> Snapshot | None:
        """What the master's agent shows, if there is one and it answers."""
        if self.agent is not None:
            with contextlib.suppress(RmpaError), ControlClient(self.agent) as client:
                return client.snapshot()
        return None


def choose_master(master: str | None, agent: str | None, environ: Mapping[str, str]) -> Master:
    """Decide which master is meant.

    Raises:
        UnreachableError: The agent that was named does not answer.
        RmpaError: Several agents run, and nothing tells which is meant.
        ConfigError: ``--master`` is no URI.
    """
    if master is not None:
        if not re.fullmatch(r"http://[^\s/:]+:[0-9]{1,5}/?", master):
            raise ConfigError("--master", f"{master!r} is not a master's URI", f"one looks like {DEFAULT_MASTER_URI}")
        return _with_agent(master, "--master", environ)
    uri = environ.get("ROS_MASTER_URI", "")
    if not agent and not environ.get("RMPA_AGENT"):
        if uri:
            return _with_agent(uri, "ROS_MASTER_URI", environ)
        if not find_agents(environ):
            return Master(DEFAULT_MASTER_URI, "no agent runs")
    found = choose_agent(environ, agent)
    with ControlClient(found.path) as client:
        return Master(client.snapshot().agent.core_uri, f"the core of agent {found.name}", found.path)


def _with_agent(uri: str, source: str, environ: Mapping[str, str]) -> Master:
    """A master that the user named, with the agent whose core it is, if it is one's."""
    for found in find_agents(environ):
        with contextlib.suppress(RmpaError), ControlClient(found.path) as client:
            if same_core(client.snapshot().agent.core_uri, uri):
                return Master(uri, source, found.path)
    others = ", ".join(found.name for found in find_agents(environ))
    # The classic mistake: a shell that still points to yesterday's robot.
    return Master(uri, f"{source}; not the core of {others}: unset it, or say --agent" if others else source)


@dataclass(frozen=True, slots=True)
class Graph:
    """What a master knows.

    Args:
        publishers: Nodes by topic.
        subscribers: Likewise.
        types: By topic; topics without a known type are not in it.
        services: Nodes by service.
    """

    publishers: dict[str, list[str]] = field(default_factory=dict)
    subscribers: dict[str, list[str]] = field(default_factory=dict)
    types: dict[str, str] = field(default_factory=dict)
    services: dict[str, list[str]] = field(default_factory=dict)

    @property
    def topics(self) -> list[str]:
        """All topics, in order."""
        return sorted(self.publishers.keys() | self.subscribers.keys())

    def peers(self, topic: str) -> list[str]:
        """The peers that publish a topic."""
        remote = (proxied_node(node) for node in self.publishers.get(topic, ()))
        return sorted({r[0] for r in remote if r is not None})

    def require(self, topic: str) -> None:
        """See that a topic is there.

        Raises:
            RmpaError: It is not; the nearest one is offered.
        """
        if topic not in self.publishers and topic not in self.subscribers:
            near = did_you_mean(topic, self.topics)
            raise RmpaError(
                f"no topic {topic}; " + (f"did you mean {near}?" if near else "`rmpa topic list` shows all")
            )


async def read_graph(master: Master) -> Graph:
    """Ask a master for its graph.

    Raises:
        UnreachableError: It does not answer.
        RmpaError: It answers with something else.
    """
    from rmpa.ros.http.client import call_api

    try:
        state = (await call_api(master.uri, "getSystemState", "/rmpa_topic")).value
        types = (await call_api(master.uri, "getTopicTypes", "/rmpa_topic")).value
    except UnreachableError:
        raise master.unreachable() from None
    match state, types:
        case [list(publishers), list(subscribers), list(services), *_], list(pairs):
            known = {str(p[0]): str(p[1]) for p in pairs if isinstance(p, list) and len(p) == 2 and p[1] != "*"}
            return Graph(_nodes(publishers), _nodes(subscribers), known, _nodes(services))
    raise RmpaError(f"{master.uri} answers getSystemState with something else; is it a ROS master?")


def _nodes(pairs: list[object]) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for pair in pairs:
        match pair:
            case [str(topic), list(nodes)]:
                found[topic] = sorted(str(node) for node in nodes)
    return found


@dataclass(frozen=True, slots=True)
class TopicName:
    """A topic or service as a user names it: ``/cmd``, ``cmd``, or ``joystick:/cmd`` for one peer's alone."""

    topic: str
    peer: str | None = None

    def takes(self, node: str) -> bool:
        """Whether a publisher's messages are meant."""
        proxy = proxied_node(node)
        return self.peer is None or (proxy is not None and proxy[0] == self.peer)

    def __str__(self) -> str:
        """As a user writes it."""
        return self.topic if self.peer is None else f"{self.peer}:{self.topic}"


def read_topic(text: str, what: str = "topic") -> TopicName:
    """Read ``TOPIC`` or ``PEER:TOPIC``; a relative topic is one of the root. ``what`` may be a service as well.

    Raises:
        ConfigError: It is no topic's name.
    """
    peer, colon, topic = text.rpartition(":")
    if not topic or not is_legal_name(topic) or topic.startswith("~") or (colon and not peer):
        raise ConfigError(what.upper(), f"{text!r} is not a {what}", "write /name, or PEER:/name for one peer's")
    return TopicName("/" + topic.strip("/"), peer or None)
