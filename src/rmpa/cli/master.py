"""The ROS master that a command asks.

In this order: ``--master``; the core of the agent named by ``--agent`` or RMPA_AGENT; ROS_MASTER_URI, as the stock
tools have it; the core of the only agent of this machine; ``http://localhost:11311``.
"""

from __future__ import annotations

import contextlib
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import ConfigError, RmpaError, UnreachableError
from rmpa.observe.control_client import ControlClient, choose_agent, find_agents, same_core
from rmpa.observe.snapshot import Snapshot
from rmpa.ros.environment import DEFAULT_MASTER_URI

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

_REMEDY: Final = "start one with `rmpa up` or `rmpa core`, or name it with --master"


@dataclass(frozen=True, slots=True)
class Master:
    """The master to ask.

    Args:
        uri: Its address.
        source: Why it was chosen (``--master``, ``ROS_MASTER_URI`` …), for the text of errors.
        agent: The control socket of the agent whose core it is; ``None`` for any other master.
    """

    uri: str
    source: str
    agent: Path | None = None

    def unreachable(self) -> UnreachableError:
        """The error for a master that does not answer."""
        return UnreachableError("ROS master", f"{self.uri} ({self.source})", _REMEDY)

    def no_agent(self) -> UnreachableError:
        """The error for a question about peers at a master that is not an agent's core."""
        remedy = "name the agent with --agent, or run `rmpa up`: only an agent knows peers"
        return UnreachableError("agent", f"{self.uri} ({self.source})", remedy)

    def snapshot(
        self,
        *,
        topics: tuple[str, ...] | None = None,
        services: tuple[str, ...] | bool | None = None,
        peers: bool = True,
    ) -> Snapshot | None:
        """The snapshot of the master's agent; ``None`` without an agent, or if it does not answer.

        Args:
            topics: Only these topics are in it; ``None``: all, which takes the agent longer.
            services: Only these are in it; ``True``: all; ``None``: all if all topics are in it, else none.
            peers: Whether peers are in it.
        """
        if self.agent is not None:
            with contextlib.suppress(RmpaError), ControlClient(self.agent) as client:
                return client.call("snapshot", Snapshot, topics=topics, services=services, peers=peers)
        return None


def choose_master(master: str | None, agent: str | None, environ: Mapping[str, str]) -> Master:
    """Choose the master, in the order that this module's docstring gives.

    Raises:
        UnreachableError: The named agent does not answer.
        RmpaError: Several agents run, and none is named.
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
        return Master(client.agent().core_uri, f"the core of agent {found.name}", found.path)


def _with_agent(uri: str, source: str, environ: Mapping[str, str]) -> Master:
    """A master given by its URI; with its agent if the URI is that of an agent's core."""
    for found in find_agents(environ):
        with contextlib.suppress(RmpaError), ControlClient(found.path) as client:
            if same_core(client.agent().core_uri, uri):
                return Master(uri, source, found.path)
    others = ", ".join(found.name for found in find_agents(environ))
    # The classic mistake: a shell that still points to yesterday's robot.
    return Master(uri, f"{source}; not the core of {others}: unset it, or say --agent" if others else source)
