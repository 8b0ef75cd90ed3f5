"""Answers ``rosnode kill`` of a proxy: asks the agent of the node's module to end the node itself."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits
from rmpa.core.errors import RmpaError
from rmpa.ros import limits as ros_limits
from rmpa.ros.core.liveness import MASTER_ID
from rmpa.ros.wire.xmlrpc import RosReply

if TYPE_CHECKING:
    from rmpa.bridge.session.peer_rpc import PeerRpc
    from rmpa.bridge.session.peer_session import PeerSession

_log = logging.getLogger(__name__)

KILL: Final = "node.kill"
"""The request to a node's agent to end the node, with ``node``, ``by`` (the caller's node) and ``reason``.

The response is a ``NodeEnd``.
"""
_REFUSED: Final = 0


class ProxyKills:
    """Answers the ``shutdown`` calls to proxies and to the agent's own node.

    ``rosnode kill -a`` calls every node of the graph in the order of their names, so the agent's own node comes
    before the proxies. It ends only the nodes of this module; nodes of other modules live on.

    Args:
        rpc: Sends the requests.
    """

    def __init__(self, rpc: PeerRpc) -> None:
        self._rpc = rpc
        self._all: dict[str, float] = {}
        self._under_way = 0

    async def own(self, caller: str, reason: str) -> RosReply:
        """Refuse to end the agent's own node, and remember the caller for ``limits.NODE_KILL_ALL`` seconds."""
        now = asyncio.get_running_loop().time()
        self._all = {other: until for other, until in self._all.items() if until > now}
        if len(self._all) < limits.NODE_KILLS_AT_ONCE:
            self._all[caller] = now + limits.NODE_KILL_ALL
        _log.info("= %s asks the agent's own node to end (%s): it stays, end the agent instead", caller, reason)
        return RosReply(_REFUSED, "this node is the agent; it ends with `rmpa up`", 0)

    async def proxy(self, session: PeerSession, node: str, caller: str, reason: str) -> RosReply:
        """End the node that a proxy stands for, because the proxy was asked to end.

        Args:
            session: The peer that has the node.
            node: The node's name in the peer's graph.
            caller: The caller's node.
            reason: The caller's reason, as text.
        """
        whose = f"{session.link.name}:{node}"
        if caller == MASTER_ID:
            # Another local node took the proxy's name. That does not concern the node at the peer.
            _log.warning("! another node has the name of the proxy of %s", whose)
            return RosReply(1, "shutdown", 0)
        problem = await self._ask(session, node, caller, reason)
        if problem:
            _log.warning("! %s, which %s asks to end, lives on: %s", whose, caller, problem)
            return RosReply(_REFUSED, problem, 0)
        _log.info("= %s was ended for %s (%s)", whose, caller, reason)
        return RosReply(1, "shutdown", 0)

    async def _ask(self, session: PeerSession, node: str, caller: str, reason: str) -> str:
        """Asks the peer to end the node; returns why it is not ended, or empty."""
        loop = asyncio.get_running_loop()
        if self._all.get(caller, 0.0) > loop.time():
            self._all[caller] = loop.time() + limits.NODE_KILL_ALL
            return "kill -a ends the nodes of this module only; name a node of another module to end it"
        if not session.linked:
            return f"{session.link.name} is not linked"
        if self._under_way >= limits.NODE_KILLS_AT_ONCE:
            return f"{self._under_way} other nodes are being ended; try again"
        self._under_way += 1
        try:
            args = {"node": node, "by": caller, "reason": reason[: limits.ASK_NAME_MAX]}
            answer = await self._rpc.request(session, KILL, args, limits.NODE_KILL_TIMEOUT)
        except RmpaError as error:
            return str(error)
        finally:
            self._under_way -= 1
        if isinstance(answer, dict) and answer.get("gone"):
            return ""
        return f"it was asked, and is still there after {ros_limits.NODE_KILL_WAIT:g} s"
