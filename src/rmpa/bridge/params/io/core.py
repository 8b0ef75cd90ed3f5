"""The parameters of the local core as XML-RPC text; long values are converted without blocking the event loop."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits
from rmpa.bridge.params.transfer import too_large
from rmpa.bridge.policy import OWN_NODE
from rmpa.core.errors import LocalProtocolError, PeerRefused, RemoteProtocolError
from rmpa.ros.http.rpc import read_large, slices
from rmpa.ros.master.parameters import holds_nil
from rmpa.ros.wire.xmlrpc import ResponseReader, response_pieces
from rmpa.runtime.loop import yielding_to_data

if TYPE_CHECKING:
    from rmpa.ros.core.api import Core
    from rmpa.ros.node.slave_node import SlaveNode
    from rmpa.ros.wire.xmlrpc import RosReply, XmlRpcValue

PEERS: Final = f"{OWN_NODE}/peers"
"""The caller's name when parameters are set for peers. A core does not notify a node of its own changes, and the
agent's node has to be notified of these."""
_PIECES: Final = 16
"""Pieces, of some KiB each, that are written before the event loop goes on with other tasks."""


async def write_text(what: str, value: XmlRpcValue) -> str:
    """Write a value as the text of an XML-RPC response.

    Args:
        what: The parameter's name, for the error.
        value: Its value.

    Raises:
        LocalProtocolError: XML-RPC cannot represent the value, or the text is above ``limits.PARAM_TEXT_MAX``.
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
    """Read the value of a text that ``write_text`` has written.

    Raises:
        RemoteProtocolError: The text is malformed, or contains a nil, which ROS does not have.
    """
    try:
        value = await read_large(ResponseReader(), (piece.encode() for piece in slices(text)))
    except UnicodeEncodeError as error:
        raise RemoteProtocolError(f"a parameter's text is not Unicode: {error.reason}") from None
    if holds_nil(value, yielding_to_data):
        raise RemoteProtocolError("the value is nil or contains one, which ROS does not have; leave it out")
    return value


class ParamCore:
    """The requests of the parameter classes to the local core.

    Args:
        core: The local core, embedded or external.
        node: The agent's own node, which the core notifies of changes.
    """

    def __init__(self, core: Core, node: SlaveNode) -> None:
        self._core = core
        self._node = node

    async def get(self, key: str) -> tuple[bool, XmlRpcValue]:
        """Whether a parameter or namespace exists, and its value, which must not be modified."""
        reply = await self._ask("getParam", OWN_NODE, key)
        return reply.code == 1, reply.value

    async def get_text(self, key: str) -> str | None:
        """The value of a parameter or namespace as text; ``None`` if it does not exist.

        Raises:
            LocalProtocolError: It is too large.
        """
        found, value = await self.get(key)
        return await write_text(key, value) if found else None

    async def set(self, key: str, value: XmlRpcValue, caller: str = OWN_NODE) -> None:
        """Set a parameter, or a namespace as a whole; the value must not be modified afterwards.

        Raises:
            PeerRefused: The core does not accept it.
        """
        reply = await self._ask("setParam", caller, key, value)
        if reply.code != 1:
            raise PeerRefused("the ROS core", f"{key}: {reply.status}")

    async def delete(self, key: str, caller: str = OWN_NODE) -> bool:
        """Delete a parameter or namespace; return whether it existed."""
        return (await self._ask("deleteParam", caller, key)).code == 1

    async def names(self) -> list[str]:
        """The names of all parameters."""
        reply = await self._ask("getParamNames", OWN_NODE)
        return [str(name) for name in reply.value] if isinstance(reply.value, list) else []

    async def follow(self, key: str) -> None:
        """Have the core notify the agent's node of changes; a repeated call has no further effect."""
        await self._ask("subscribeParam", OWN_NODE, self._node.uri, key)

    async def leave(self, key: str) -> None:
        """End these notifications."""
        await self._ask("unsubscribeParam", OWN_NODE, self._node.uri, key)

    async def run_id(self) -> XmlRpcValue:
        """The id of this run of the core; another run has none of the values and subscriptions of the one before."""
        return (await self.get("/run_id"))[1]

    async def _ask(self, method: str, *params: XmlRpcValue) -> RosReply:
        return await self._core.ask(method, *params)
