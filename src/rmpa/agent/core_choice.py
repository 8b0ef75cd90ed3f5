"""Chooses the ROS core of an agent: an embedded one, or a roscore that runs already."""

from __future__ import annotations

import logging
import os
from typing import TYPE_CHECKING

from rmpa.bridge.policy import OWN_NODE, is_own
from rmpa.config.state_dir import core_file
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.core.external import ExternalCore
from rmpa.ros.environment import DEFAULT_MASTER_URI, RosEnvironment, host_of, is_loopback
from rmpa.ros.http.client import is_own_name
from rmpa.ros.node.local_addresses import local_addresses

if TYPE_CHECKING:
    from rmpa.config.settings import Settings
    from rmpa.ros.core.api import Core

_log = logging.getLogger(__name__)


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
