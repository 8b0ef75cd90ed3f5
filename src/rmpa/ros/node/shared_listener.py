"""Two listening sockets for any number of nodes: each node has a loopback address, all have the same two ports.

A socket that listens at all addresses and is bound to the device ``lo`` accepts connections to any address
``127.a.b.c`` (there are 16 million), and none from the network. The local address of the accepted socket identifies
the node. A path in the URI could do so too, but roscpp drops it.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from typing import TYPE_CHECKING, Final

from rmpa.core.counters import Counters
from rmpa.core.errors import StartError
from rmpa.ros import limits
from rmpa.ros.http.connection import RESET
from rmpa.ros.http.server import ResetConnection, XmlRpcServer
from rmpa.ros.node.loopback_addresses import LoopbackAddresses
from rmpa.runtime.accept import DESCRIPTORS, Acceptor, Use

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.ros.wire.xmlrpc import XmlRpcValue

    Adopt = Callable[[socket.socket, tuple[str, int]], None]
    """Takes ownership of an accepted, non-blocking socket; the second argument is the client's address."""

_log = logging.getLogger(__name__)
_DEVICE: Final = b"lo"


class SharedListener:
    """The two sockets, and the nodes by address.

    Args:
        salt: Distinguishes nodes of one name in several graphs of this machine: the master's URI.
        counters: ``address.unknown.xmlrpc``, ``address.unknown.tcpros``: connections to addresses without a node.
    """

    def __init__(self, salt: str, *, counters: Counters | None = None) -> None:
        self._counters = counters if counters is not None else Counters()
        self._salt = salt
        self._addresses = LoopbackAddresses(salt)
        self._http = _Port("XML-RPC of the proxies", self._answer_stray)
        self._tcpros = _Port("TCPROS of the proxies", self._reset_stray)
        self._strays = XmlRpcServer(_former_node, counters=self._counters, name="addresses of former nodes")

    def __len__(self) -> int:
        """Nodes with an address."""
        return len(self._addresses)

    @property
    def ports(self) -> tuple[int, int]:
        """The port of XML-RPC and that of TCPROS; 0 before ``start()``."""
        return self._http.number, self._tcpros.number

    async def start(self) -> None:
        """Listen, and test whether the addresses work on this machine.

        Raises:
            StartError: The device cannot be bound, or its addresses are not 127.0.0.0/8.
        """
        try:
            for port in (self._http, self._tcpros):
                port.listen()
            # Containers, sandboxes and firewalls differ, so one connection is tried.
            await _test_address(LoopbackAddresses(self._salt).take("", 0.0), self._tcpros)
        except BaseException as error:
            await self.close()
            if isinstance(error, OSError):
                problem = error.strerror or str(error) or type(error).__name__
                raise StartError("one listening socket for all proxies", problem) from error
            raise
        _log.info("= proxies listen at 127.x addresses of their own, ports %d (XML-RPC) and %d (TCPROS)", *self.ports)

    async def close(self) -> None:
        """Stop listening; the owner has closed the nodes before."""
        self._http.close()
        self._tcpros.close()
        await self._strays.close()

    def attach(self, name: str, http: Adopt, tcpros: Adopt) -> str:
        """Assign an address to a node; only between ``start()`` and ``close()``.

        Args:
            name: The node's name.
            http: Gets each connection to its XML-RPC port.
            tcpros: Gets each connection to its TCPROS port.

        Returns:
            The address; the ports are ``ports``.
        """
        address = self._addresses.take(name, asyncio.get_running_loop().time())
        self._http.nodes[address] = http
        self._tcpros.nodes[address] = tcpros
        return address

    def detach(self, address: str) -> None:
        """Free an address; the node closes its connections itself."""
        self._http.nodes.pop(address, None)
        self._tcpros.nodes.pop(address, None)
        self._addresses.free(address, asyncio.get_running_loop().time())

    def _answer_stray(self, sock: socket.socket, client: tuple[str, int]) -> None:
        """Take a call to the address of a closed node: see ``_former_node``."""
        self._counters.add("address.unknown.xmlrpc")
        self._strays.adopt(sock, client)

    def _reset_stray(self, sock: socket.socket, _client: tuple[str, int]) -> None:
        """Reset a TCPROS connection to the address of a closed node, as a closed port would: roscpp backs off."""
        self._counters.add("address.unknown.tcpros")
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
        sock.close()


class _Port:
    """One of the two sockets.

    Args:
        name: Its purpose, for messages.
        stray: Gets the connections to addresses without a node.
    """

    def __init__(self, name: str, stray: Adopt) -> None:
        self.nodes: dict[str, Adopt] = {}
        """The takers of accepted connections, by the nodes' addresses."""
        self.number = 0
        self._name = name
        self._stray = stray
        self._acceptor: Acceptor | None = None

    def listen(self) -> None:
        """Bind and accept.

        Raises:
            OSError: This is not allowed, or there is no such device.
        """
        sock = DESCRIPTORS.open_socket(Use.DATA)
        try:
            # Before it is bound to all addresses, so that the network can never reach it.
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, _DEVICE)
            sock.bind(("0.0.0.0", 0))  # noqa: S104 - of the device lo
            sock.listen(limits.SHARED_BACKLOG)
        except BaseException:
            sock.close()
            raise
        self.number = sock.getsockname()[1]
        self._acceptor = Acceptor(sock, self._accepted, name=self._name)
        self._acceptor.start()

    def close(self) -> None:
        """Stop listening."""
        if self._acceptor is not None:
            self._acceptor.close()

    def _accepted(self, sock: socket.socket, client: tuple[str, int]) -> None:
        self.nodes.get(sock.getsockname()[0], self._stray)(sock, client)


async def _test_address(address: str, port: _Port) -> None:
    """Connect to an address, and wait until the connection is accepted with it.

    Raises:
        OSError: The connection fails, or is not accepted in ``limits.SHARED_PROBE_TIMEOUT``.
    """
    loop = asyncio.get_running_loop()
    arrived: asyncio.Future[None] = loop.create_future()

    def arrive(sock: socket.socket, _client: tuple[str, int]) -> None:
        sock.close()
        if not arrived.done():
            arrived.set_result(None)

    port.nodes[address] = arrive
    try:
        with DESCRIPTORS.open_socket(Use.DATA) as probe:
            async with asyncio.timeout(limits.SHARED_PROBE_TIMEOUT):
                await loop.sock_connect(probe, (address, port.number))
                await arrived
    except TimeoutError as error:
        raise OSError(f"a connection to {address} on this machine does not arrive") from error
    finally:
        del port.nodes[address]


def _former_node(method: str, _params: tuple[XmlRpcValue, ...], _client: str) -> XmlRpcValue:
    """Reset the connection, by which ``rosnode`` and others know a dead node; an error in the answer stops them.

    Answered are ``requestTopic``, which rospy repeats twice a minute after a reset until its process ends,
    and ``getName``, by which agents tell this listener from one that is stuck.

    Raises:
        ResetConnection: For all other methods.
    """
    if method not in ("requestTopic", "getName"):
        raise ResetConnection
    return [-1, "the node that had this address is gone", 0]
