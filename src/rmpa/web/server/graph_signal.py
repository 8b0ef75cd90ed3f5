"""Changes of the graph as the agent tells them, so that the hub has them at once and need not read all of it."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import TYPE_CHECKING, TypeVar

import msgspec

from rmpa.core.errors import RemoteProtocolError, RmpaError
from rmpa.observe import limits as observe_limits
from rmpa.observe.control import ControlReply, ControlRequest, GraphRevision
from rmpa.observe.control_client import choose_agent, same_core
from rmpa.web import limits

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Mapping
    from pathlib import Path

    from rmpa.web.hub.graph import GraphWatch

_log = logging.getLogger(__name__)
_T = TypeVar("_T")


class GraphSignal:
    """Waits for changes at the control socket, one question after the other, and gives them to the graph.

    An older agent, and one whose core is another program, tells only that there is a change: then the master is asked
    for the graph. While no agent answers, the master is asked again and again.

    Args:
        environ: Says where the sockets are.
        agent: Returns the agent's name; ``None``: the one that ``choose_agent`` finds.
        graph: Takes the changes.
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
                self._graph.lose()
            await asyncio.sleep(limits.NODE_RETRY)

    async def _follow(self) -> None:
        master = await self._graph.master()
        agent = await asyncio.to_thread(choose_agent, self._environ, self._agent())
        # Only the first answer, and one after more changes than the agent keeps, has the whole graph.
        async with control_stream(agent.path) as (reader, writer):
            known: int | None = None
            while True:
                args: dict[str, object] = {"after": known, "wait": limits.GRAPH_WAIT, "rows": True}
                async with asyncio.timeout(limits.GRAPH_WAIT + limits.WEB_AGENT_TIMEOUT):
                    told = await ask(reader, writer, ControlRequest("graph", args), GraphRevision)
                known = await self._take(told, known, master)

    async def _take(self, told: GraphRevision, known: int | None, master: str) -> int:
        if told.rows is None:
            if told.revision != known:
                self._graph.look()
            self._graph.told = True
        elif not same_core(told.core_uri, master):
            raise RemoteProtocolError(f"the agent's core is {told.core_uri}, and this node's {master}")
        elif told.revision != known:
            loop = asyncio.get_running_loop()
            began = loop.time()
            self._graph.take(told.rows)
            # Changes of the next moment come together: in a storm of them, half of the time is spent here.
            await asyncio.sleep(max(limits.GRAPH_GATHER, loop.time() - began))
        return told.revision


@contextlib.asynccontextmanager
async def control_stream(path: Path) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    """A connection to an agent's control socket."""
    reader, writer = await asyncio.open_unix_connection(path, limit=observe_limits.CONTROL_REPLY_MAX)
    try:
        yield reader, writer
    finally:
        writer.close()
        with contextlib.suppress(OSError):
            await writer.wait_closed()


async def ask(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, request: ControlRequest, kind: type[_T]
) -> _T:
    """The agent's answer to a request.

    Raises:
        RemoteProtocolError: It is refused, or of another kind.
    """
    writer.write(request.serialize())
    reply = ControlReply.parse(await reader.readuntil(b"\n"))
    if not reply.ok:
        raise RemoteProtocolError(reply.error)
    try:
        return msgspec.convert(reply.value, kind)
    except msgspec.ValidationError as error:
        raise RemoteProtocolError(f"the agent answers {request.op} in another way: {error}") from None
