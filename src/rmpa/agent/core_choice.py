"""Chooses the ROS core of an agent: an embedded one, or a roscore that runs already."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import os
from typing import TYPE_CHECKING, Final

from rmpa.bridge.policy import OWN_NODE, is_own
from rmpa.config.module_name import core_file
from rmpa.core.errors import RmpaError, StartError
from rmpa.observe.io.control_client import ControlClient, find_agents
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.core.external import ExternalCore
from rmpa.ros.environment import DEFAULT_MASTER_URI, RosEnvironment, host_of, is_loopback
from rmpa.ros.http.rpc import call_api, is_own_name
from rmpa.ros.node.listeners import local_addresses

if TYPE_CHECKING:
    from rmpa.config.settings import Settings
    from rmpa.observe.snapshot import AgentInfo
    from rmpa.ros.core.api import Core

_log = logging.getLogger(__name__)
_ASKED: Final = 1.0
"""Seconds in which a program that has the core's port says whether it is a ROS master."""


async def start_core(core: Core, settings: Settings) -> None:
    """Start the module's core.

    Raises:
        StartError: Its port is taken, or the address cannot be used; the text says how to join what has the port.
    """
    try:
        await core.start()
    except StartError as error:
        cause, port = error.__cause__, settings.core_port
        if not isinstance(cause, OSError) or cause.errno != errno.EADDRINUSE:
            raise
        if (agent := await asyncio.to_thread(_agent_at, port, settings.runtime_dir)) is not None:
            error.problem = f"port {port} is already in use by the agent {agent.name} (pid {agent.pid})"
            error.remedy = (
                f"nodes with ROS_MASTER_URI=http://localhost:{port} are in its module, and so are resources by "
                f"`rmpa run FILE --name {agent.name}`; a second module here needs another --name and --core-port"
            )
        elif await _is_other_master(port):
            error.remedy = "join its graph with `rmpa up --core external`, or end it, or choose another --core-port"
        raise


def _agent_at(port: int, runtime_dir: str) -> AgentInfo | None:
    """The agent of this machine whose core has a port."""
    for found in find_agents({**os.environ, "RMPA_RUNTIME_DIR": runtime_dir} if runtime_dir else os.environ):
        with contextlib.suppress(RmpaError), ControlClient(found.path) as client:
            agent = client.agent()
            if agent.core_uri.rstrip("/").endswith(f":{port}"):
                return agent
    return None


async def _is_other_master(port: int) -> bool:
    """Whether a ROS master without an agent answers at a port of this machine."""
    uri = f"http://127.0.0.1:{port}/"
    try:
        answers = (await call_api(uri, "getUri", OWN_NODE, timeout=_ASKED)).code == 1
        return answers and (await call_api(uri, "lookupNode", OWN_NODE, OWN_NODE, timeout=_ASKED)).code != 1
    except RmpaError:
        return False


def make_core(settings: Settings) -> Core:
    """The core that the settings ask for, not yet started.

    Raises:
        ConfigError: A ROS variable cannot be used.
    """
    if settings.core_mode == "embedded":
        state = core_file(os.environ, settings.core_port, settings.name, settings.state_dir)
        if state is None and settings.core_port:
            _log.warning("! the core keeps nothing over a restart: there is no home; set RMPA_STATE_DIR")
        return RosCore(
            settings.core_host,
            settings.core_port,
            state=state,
            keep=settings.core_keep,
            temporary=is_own,
        )
    uri = settings.core_master or DEFAULT_MASTER_URI
    # Proxies have the address that a node started in this shell would have. Where the shell asks for none, it is that
    # of the master: loopback if the master is only there, or the machine's name if the master goes by it, as that
    # works without a network.
    variables = {name: os.environ.get(name, "") for name in ("ROS_HOSTNAME", "ROS_IP")}
    environment = RosEnvironment.read(variables, (), local_addresses())
    address, master = environment.host, host_of(uri)
    if not environment.host_given and (is_loopback(master) or is_own_name(master)):
        address = "127.0.0.1" if is_loopback(master) else master
    host = "127.0.0.1" if is_loopback(address) else "0.0.0.0"  # noqa: S104 - as every node of such a graph does
    return ExternalCore(uri, own_node=OWN_NODE, node_host=host, node_address=address)
