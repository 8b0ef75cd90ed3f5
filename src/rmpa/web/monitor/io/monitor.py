"""The server's side of the monitor: what all pages share."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from rmpa.web.monitor.io.log_feed import LogFeed
from rmpa.web.monitor.io.mesh_feed import MeshFeed
from rmpa.web.monitor.io.questions import Answers
from rmpa.web.monitor.io.resource_watch import ResourceWatch
from rmpa.web.monitor.io.values import MessageValues

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.web.hub.hub import Hub
    from rmpa.web.server.agent_watch import AgentWatch


class Monitor:
    """Follows the mesh for all pages. The log is kept from ``start`` on.

    Args:
        hub: Subscribes, and calls services.
        watch: Asks the agent.
        environ: Says where the agents' sockets are; the process's environment unless it is given.
        agent: The agent's name; ``None``: the one that answers.
    """

    def __init__(
        self,
        hub: Hub,
        watch: AgentWatch,
        environ: Mapping[str, str] | None = None,
        agent: str | None = None,
    ) -> None:
        self._hub = hub
        self.values = MessageValues(hub)
        self.resources = ResourceWatch(hub, self.values)
        self.log = LogFeed(hub, self.values)
        self.mesh = MeshFeed(watch, self.resources, lambda: hub.params.changes)
        self.answers = Answers(
            hub,
            self.resources,
            os.environ if environ is None else environ,
            lambda: agent or self.mesh.agent,
        )

    def start(self) -> None:
        """Begin to keep lines of the log; the hub has an event loop by now."""
        self._hub.start()
        self.resources.start()
        self.log.start()
        self.mesh.start()

    async def ready(self) -> None:
        """Wait until the agent was asked once, so that a page is told its name."""
        await self.mesh.first()

    async def close(self) -> None:
        """End, before the hub ends."""
        await self.mesh.close()
        self.answers.close()
        self.log.close()
        self.resources.close()
