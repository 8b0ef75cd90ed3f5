"""Whether a server fits the agent that it speaks to: it is never less secure than that."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import TYPE_CHECKING

from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.observe.control import ControlRequest
from rmpa.observe.control_client import ControlClient, choose_agent, find_agents, same_core
from rmpa.trust.joining import TrustStatus
from rmpa.web import limits
from rmpa.web.server.graph_signal import ask, control_stream

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.observe.control_client import FoundAgent
    from rmpa.observe.snapshot import Snapshot

_log = logging.getLogger(__name__)


class TrustWatch:
    """Notices an agent that is secured in another way than this server: the server is then to be made anew.

    It holds a connection to the agent's control socket, whose end tells that the agent may be another one now: also
    one of another name that took over the core, since the server's node stays registered there.

    Args:
        environ: Says where the sockets are.
        agent: The agent's name; ``None``: the one that ``choose_agent`` finds.
        fits: Whether this server may speak to an agent; ``None``: one without trust.
    """

    def __init__(
        self, environ: Mapping[str, str], agent: str | None, fits: Callable[[TrustStatus | None], bool]
    ) -> None:
        self._environ = environ
        self._agent = agent
        self._core = ""
        self._fits = fits
        self._loop = asyncio.get_running_loop()
        self._task: asyncio.Task[None] | None = None
        self.misfit = asyncio.Event()
        """Set once an agent answers that this server may not speak to."""

    def start(self) -> None:
        """Begin, in a task."""
        self._task = self._loop.create_task(self._run(), name="watch whether the agent is secured")

    async def close(self) -> None:
        """End."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait([self._task])

    def check(self, snapshot: Snapshot) -> None:
        """Check the agent that sent a snapshot; may be called in any thread.

        Raises:
            PeerRefused: This server may not show it.
        """
        if not self._fits(snapshot.trust):
            self._loop.call_soon_threadsafe(self.misfit.set)
            problem = "is secured, and this server begins anew with its certificate and permissions"
            raise PeerRefused(f"agent {snapshot.agent.name}", problem, "ask again")

    async def _run(self) -> None:
        pause = limits.TRUST_RETRY
        while not self.misfit.is_set():
            try:
                await self._follow()
                pause = limits.TRUST_RETRY
            except (RmpaError, OSError, EOFError, TimeoutError, asyncio.LimitOverrunError) as error:
                _log.debug("! whether the agent is secured is not known: %s", error)
            await asyncio.sleep(pause)
            pause = min(2 * pause, limits.NODE_RETRY)

    async def _follow(self) -> None:
        """Ask one run of an agent, and wait for its end."""
        agent = await asyncio.to_thread(self._find)
        async with control_stream(agent.path) as (reader, writer):
            async with asyncio.timeout(limits.WEB_AGENT_TIMEOUT):
                status = await ask(reader, writer, ControlRequest("trust", {"what": "status"}), TrustStatus)
            if not self._fits(status if status.on else None):
                self.misfit.set()
                return
            self._agent = self._agent or agent.name
            await reader.read()  # idle connections are ended, too: then it is asked again

    def _find(self) -> FoundAgent:
        """The agent; where it does not run, one that has its core."""
        agents = find_agents(self._environ)
        found = next((agent for agent in agents if agent.name == self._agent), None)
        for agent in agents if found is None and self._core else ():
            with contextlib.suppress(RmpaError), ControlClient(agent.path) as client:
                if same_core(client.agent().core_uri, self._core):
                    return agent
        if found is None:
            found = choose_agent(self._environ, self._agent)
        with ControlClient(found.path) as client:
            self._core = client.agent().core_uri
        return found
