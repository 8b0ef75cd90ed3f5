"""The local core's parameters as XML-RPC text: any core's, and never long at a time."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits
from rmpa.bridge.params.transfer import too_large
from rmpa.bridge.policy import OWN_NODE
from rmpa.core.errors import LocalProtocolError, PeerRefused, RemoteProtocolError
from rmpa.ros.http.documents import read_large, slices
from rmpa.ros.master.parameters import holds_nil
from rmpa.ros.wire.xmlrpc import ResponseReader, response_pieces
from rmpa.runtime.event_loop import yielding_to_data

if TYPE_CHECKING:
    from rmpa.ros.core.api import Core
    from rmpa.ros.node.slave_node import SlaveNode
    from rmpa.ros.wire.xmlrpc import RosReply, XmlRpcValue

PEERS: Final = f"{OWN_NODE}/peers"
"""Sets parameters for peers: a core does not tell a node of what it sets itself, and ours is to be told of these."""
_PIECES: Final = 16
"""Pieces of some KiB that are written before the loop has its turn."""


async def write_text(what: str, value: XmlRpcValue) -> str:
    """A value as the text of an XML-RPC response.

    Raises:
        LocalProtocolError: It cannot be said, or is too large.
    """
    parts: list[str] = []
    size = 0
    for number, piece in enumerate(yielding_to_data(response_pieces(value), every=1), start=1):
        parts.append(piece.decode())  # pieces end between characters
        size += len(piece)
        if size > limits.PARAM_TEXT_MAX:
            raise LocalProtocolError(too_large(what, size))
        if number % _PIECES == 0:
            await asyncio.sleep(0)
    return "".join(parts)


async def read_text(text: str) -> XmlRpcValue:
    """The value of such a text.

    Raises:
        RemoteProtocolError: It is none, or holds a nil, which ROS does not have.
    """
    try:
        value = await read_large(ResponseReader(), (piece.encode() for piece in slices(text)))
    except UnicodeEncodeError as error:
        raise RemoteProtocolError(f"a parameter's text is not Unicode: {error.reason}") from None
    if holds_nil(value, yielding_to_data):
        raise RemoteProtocolError("the value is nil or contains one, which ROS does not have; leave it out")
    return value


class ParamCore:
    """What the parts for parameters ask of the local core.

    Args:
        core: Any.
        node: The agent's own node, which is told of changes.
    """

    def __init__(self, core: Core, node: SlaveNode) -> None:
        self._core = core
        self._node = node

    async def get(self, key: str) -> tuple[bool, XmlRpcValue]:
        """Whether there is a parameter or namespace, and its value, which is not to be changed."""
        reply = await self._ask("getParam", OWN_NODE, key)
        return reply.code == 1, reply.value

    async def get_text(self, key: str) -> str | None:
        """Its value as text, or ``None``.

        Raises:
            LocalProtocolError: It is too large.
        """
        found, value = await self.get(key)
        return await write_text(key, value) if found else None

    async def set(self, key: str, value: XmlRpcValue, caller: str = OWN_NODE) -> None:
        """Set a parameter, or a namespace as a whole; the value must not be changed afterwards.

        Raises:
            PeerRefused: The core does not take it.
        """
        reply = await self._ask("setParam", caller, key, value)
        if reply.code != 1:
            raise PeerRefused("the ROS core", f"{key}: {reply.status}")

    async def delete(self, key: str, caller: str = OWN_NODE) -> bool:
        """Take a parameter or namespace away; whether there was one."""
        return (await self._ask("deleteParam", caller, key)).code == 1

    async def names(self) -> list[str]:
        """The names of all parameters."""
        reply = await self._ask("getParamNames", OWN_NODE)
        return [str(name) for name in reply.value] if isinstance(reply.value, list) else []

    async def follow(self, key: str) -> None:
        """Have the agent's node told of changes; again does no harm."""
        await self._ask("subscribeParam", OWN_NODE, self._node.uri, key)

    async def leave(self, key: str) -> None:
        """Have it told no longer."""
        await self._ask("unsubscribeParam", OWN_NODE, self._node.uri, key)

    async def run_id(self) -> XmlRpcValue:
        """Names this run of the core; another one knows nothing of what we set and follow."""
        return (await self.get("/run_id"))[1]

    async def _ask(self, method: str, *params: XmlRpcValue) -> RosReply:
        return await self._core.ask(method, *params)
