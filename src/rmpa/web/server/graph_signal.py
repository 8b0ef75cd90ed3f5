"""The agent's word that the graph has changed, so that the hub reads it at once and not twelve times a second."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import TYPE_CHECKING

import msgspec

from rmpa.core.errors import RemoteProtocolError, RmpaError
from rmpa.core.sizes import KIB
from rmpa.observe.control import ControlReply, ControlRequest
from rmpa.observe.io.control_client import choose_agent
from rmpa.observe.snapshot import GraphRevision
from rmpa.web import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.web.hub.graph import GraphWatch

_log = logging.getLogger(__name__)
_REPLY_MAX = 4 * KIB


class GraphSignal:
    """Waits for changes at the control socket, one question after the other, and has the graph read.

    Without it (no agent answers, or an older one) the graph is read again and again.

    Args:
        environ: Says where the sockets are.
        agent: Returns the agent's name; ``None``: the one that ``choose_agent`` finds.
        graph: Reads the graph.
    """

    def __init__(self, environ: Mapping[str, str], agent: Callable[[], str | None], graph: GraphWatch) -> None:
        self._environ = environ
        self._agent = agent
        self._graph = graph
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Begin, in a task."""
        self._task = asyncio.get_running_loop().create_task(self._run(), name="wait for changes of the graph")

    async def close(self) -> None:
        """End."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait([self._task])

    async def _run(self) -> None:
        while True:
            try:
                await self._follow()
            except (RmpaError, OSError, EOFError, asyncio.LimitOverrunError) as error:
                _log.debug("! changes of the graph are not told: %s", error)
            finally:
                self._graph.told = False
                self._graph.look()
            await asyncio.sleep(limits.NODE_RETRY)

    async def _follow(self) -> None:
        agent = await asyncio.to_thread(choose_agent, self._environ, self._agent())
        reader, writer = await asyncio.open_unix_connection(agent.path, limit=_REPLY_MAX)
        try:
            known: int | None = None
            while True:
                request = ControlRequest("graph", {"after": known, "wait": limits.GRAPH_WAIT})
                writer.write(request.serialize())
                async with asyncio.timeout(limits.GRAPH_WAIT + limits.WEB_AGENT_TIMEOUT):
                    line = await reader.readuntil(b"\n")
                revision = _revision(line)
                if revision != known:
                    known = revision
                    self._graph.look()
                self._graph.told = True
        finally:
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()


def _revision(line: bytes) -> int:
    reply = ControlReply.parse(line)
    if not reply.ok:
        raise RemoteProtocolError(reply.error)
    try:
        return msgspec.convert(reply.value, GraphRevision).revision
    except msgspec.ValidationError as error:
        raise RemoteProtocolError(f"the agent answers graph in another way: {error}") from None
