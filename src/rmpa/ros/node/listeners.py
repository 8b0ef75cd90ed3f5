"""The addresses of nodes: those of this machine, and a loopback address for each proxy at one pair of ports."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import itertools
import logging
import socket
from collections import OrderedDict
from typing import TYPE_CHECKING, Final

import psutil

from rmpa.core.errors import StartError
from rmpa.core.statistics import Counters
from rmpa.ros import limits
from rmpa.ros.http.server import RESET, ResetConnection, XmlRpcServer
from rmpa.runtime.accept import DESCRIPTORS, Acceptor, Use

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.ros.wire.xmlrpc import XmlRpcValue

    # Takes ownership of an accepted, non-blocking socket; the second argument is the client's address.
    Adopt = Callable[[socket.socket, tuple[str, int]], None]

_log = logging.getLogger(__name__)

# Time-out of the test whether addresses of 127/8 other than 127.0.0.1 work here; if so, it takes a millisecond.
SHARED_PROBE_TIMEOUT: Final = 1.0
# Time before a freed loopback address is used again: three times the 20 s for which roscpp dials an old one.
LOOPBACK_REST: Final = 60.0

# Listen queue of all proxies' one socket: all subscribers of a restarted agent connect at once.
_SHARED_BACKLOG: Final = 4096


def local_addresses() -> list[str]:
    """IPv4 addresses of the interfaces that are up, in the system's order; those of loopback last."""
    up = {name for name, state in psutil.net_if_stats().items() if state.isup}
    found = [
        address.address
        for name, addresses in psutil.net_if_addrs().items()
        if name in up
        for address in addresses
        if address.family == socket.AF_INET
    ]
    return sorted(found, key=lambda address: address.startswith("127."))


# Assigns loopback addresses ``127.a.b.c`` to nodes that share one port. The dialled address identifies the node.


# Values of ``a``, from 1 on: 127.0/16 has localhost, Debian's 127.0.1.1 and the resolvers; 127.255/16 broadcasts.
_FIRST: Final = 254
_SECOND: Final = 256
# Values of ``c``, from 1 on: an address that ends in 0 or 255 looks like a network's own.
_THIRD: Final = 254


def loopback_addresses(salt: str, name: str) -> Iterator[str]:
    """The addresses that a node may have, the one that it prefers first; there are 16 million.

    An address is a hash of the node's name: it is the same after a restart, and hardly ever another node's, so a
    client with an old address is refused instead of reaching the wrong node.

    Args:
        salt: Distinguishes nodes of one name in several graphs of this machine, such as the master's URI.
        name: The node's name.
    """
    for attempt in itertools.count():
        text = f"{salt}\0{name}\0{attempt}"
        number = int.from_bytes(hashlib.blake2s(text.encode(errors="backslashreplace"), digest_size=8).digest())
        rest, third = divmod(number, _THIRD)
        first, second = divmod(rest % (_FIRST * _SECOND), _SECOND)
        yield f"127.{1 + first}.{second}.{1 + third}"


# Two listening sockets for any number of nodes. Each node has a loopback address, all have the same two ports.
#
# A socket that listens at all addresses and is bound to the device ``lo`` accepts connections to any address
# ``127.a.b.c`` (there are 16 million), and none from the network. The local address of the accepted socket identifies
# the node. A path in the URI could do so too, but roscpp drops it.


_DEVICE: Final = b"lo"


class SharedListener:
    """The two sockets, and the nodes by address.

    A freed address is not used again for ``LOOPBACK_REST``, even for the same node: rospy takes a URI that it has
    just lost for one that it still has, and does not reconnect.

    Args:
        salt: Distinguishes nodes of one name in several graphs of this machine: the master's URI.
        counters: ``address.unknown.xmlrpc``, ``address.unknown.tcpros``: connections to addresses without a node.

    Attributes:
        ports: The port of XML-RPC and that of TCPROS; 0 before ``start()``.
    """

    def __init__(self, salt: str, *, counters: Counters | None = None) -> None:
        self._counters = counters if counters is not None else Counters()
        self._salt = salt
        # Addresses that were freed a short while ago, and when; the oldest first.
        self._resting: OrderedDict[str, float] = OrderedDict()
        # By address: what takes the connections to the XML-RPC port, and those to the TCPROS port.
        self._nodes: dict[str, tuple[Adopt, Adopt]] = {}
        self._acceptors: list[Acceptor] = []
        self.ports = (0, 0)
        self._strays = XmlRpcServer(_former_node, counters=self._counters, name="addresses of former nodes")

    async def start(self) -> None:
        """Listen, and test whether the addresses work on this machine.

        Raises:
            StartError: The device cannot be bound, or its addresses are not 127.0.0.0/8.
        """
        try:
            self.ports = self._listen(0, "XML-RPC of the proxies"), self._listen(1, "TCPROS of the proxies")
            # Containers, sandboxes and firewalls differ, so one connection is tried.
            await self._test_address(next(loopback_addresses(self._salt, "")))
        except BaseException as error:
            await self.close()
            if isinstance(error, OSError):
                problem = error.strerror or str(error) or type(error).__name__
                raise StartError("one listening socket for all proxies", problem, code="port-in-use") from error
            raise
        _log.info("= proxies listen at 127.x addresses of their own, ports %d (XML-RPC) and %d (TCPROS)", *self.ports)

    async def close(self) -> None:
        """Stop listening; the owner has closed the nodes before."""
        for acceptor in self._acceptors:
            acceptor.close()
        await self._strays.close()

    def attach(self, name: str, http: Adopt, tcpros: Adopt) -> str:
        """Assign an address to a node.

        Args:
            name: The node's name.
            http: Gets each connection to its XML-RPC port.
            tcpros: Gets each connection to its TCPROS port.

        Returns:
            The address; the ports are ``ports``.
        """
        self._release_rested()
        candidates = loopback_addresses(self._salt, name)
        address = next(each for each in candidates if each not in self._nodes and each not in self._resting)
        self._nodes[address] = http, tcpros
        return address

    def detach(self, address: str) -> None:
        """Free an address; the node closes its connections itself. Nothing happens if no node has it."""
        if self._nodes.pop(address, None) is not None:
            self._resting[address] = asyncio.get_running_loop().time()
            self._release_rested()

    def _release_rested(self) -> None:
        """Release addresses that rested long enough, and the oldest of too many."""
        now = asyncio.get_running_loop().time()
        while self._resting:
            since = next(iter(self._resting.values()))
            if now - since < LOOPBACK_REST and len(self._resting) <= limits.LOOPBACK_RESTING_MAX:
                return
            self._resting.popitem(last=False)

    def _listen(self, which: int, name: str) -> int:
        """Bind one of the two sockets and accept; return its port.

        Raises:
            OSError: This is not allowed, or there is no such device.
        """
        stray = (self._answer_stray, self._reset_stray)[which]

        def accepted(sock: socket.socket, client: tuple[str, int]) -> None:
            node = self._nodes.get(sock.getsockname()[0])
            (node[which] if node is not None else stray)(sock, client)

        with contextlib.ExitStack() as on_error:
            sock = on_error.enter_context(DESCRIPTORS.open_socket(Use.DATA))
            # Before it is bound to all addresses, so that the network can never reach it.
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, _DEVICE)
            sock.bind(("0.0.0.0", 0))  # noqa: S104 - of the device lo
            sock.listen(_SHARED_BACKLOG)
            on_error.pop_all()
        acceptor = Acceptor(sock, accepted, name=name)
        acceptor.start()
        self._acceptors.append(acceptor)
        return int(sock.getsockname()[1])

    def _answer_stray(self, sock: socket.socket, client: tuple[str, int]) -> None:
        """Take a call to the address of a closed node: see ``_former_node``."""
        self._counters.add("address.unknown.xmlrpc")
        self._strays.adopt(sock, client)

    def _reset_stray(self, sock: socket.socket, _client: tuple[str, int]) -> None:
        """Reset a TCPROS connection to the address of a closed node, as a closed port would: roscpp backs off."""
        self._counters.add("address.unknown.tcpros")
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
        sock.close()

    async def _test_address(self, address: str) -> None:
        """Connect to an address, and wait until the connection is accepted with it.

        Raises:
            OSError: The connection fails, or is not accepted in ``SHARED_PROBE_TIMEOUT``.
        """
        loop = asyncio.get_running_loop()
        arrived: asyncio.Future[None] = loop.create_future()

        def arrive(sock: socket.socket, _client: tuple[str, int]) -> None:
            sock.close()
            if not arrived.done():
                arrived.set_result(None)

        self._nodes[address] = arrive, arrive
        try:
            with DESCRIPTORS.open_socket(Use.DATA) as probe:
                async with asyncio.timeout(SHARED_PROBE_TIMEOUT):
                    await loop.sock_connect(probe, (address, self.ports[1]))
                    await arrived
        except TimeoutError as error:
            raise OSError(f"a connection to {address} on this machine does not arrive") from error
        finally:
            del self._nodes[address]


def _former_node(method: str, _params: tuple[XmlRpcValue, ...]) -> XmlRpcValue:
    """Reset the connection, by which ``rosnode`` and others know a dead node; an error in the answer stops them.

    Answered are ``requestTopic``, which rospy repeats twice a minute after a reset until its process ends,
    and ``getName``, by which agents tell this listener from one that is stuck.

    Raises:
        ResetConnection: For all other methods.
    """
    if method not in ("requestTopic", "getName"):
        raise ResetConnection
    return [-1, "the node that had this address is gone", 0]
