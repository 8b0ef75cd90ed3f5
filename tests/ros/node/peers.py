"""The other side of TCPROS connections, made of bare sockets, so that it can do wrong."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Mapping
from typing import ClassVar, Final, Self

from rmpa.ros.core.embedded import RosCore
from rmpa.ros.environment import RosEnvironment
from rmpa.ros.http.server import XmlRpcServer
from rmpa.ros.node.node import Node
from rmpa.ros.wire.tcpros import LENGTH, TopicDescription, encode_header, parse_header, publisher_header
from rmpa.ros.wire.xmlrpc import XmlRpcValue
from tests.waiting import DEADLINE

MD5: Final = "992ce8a1687cec8c8bd883ec73ca41d1"
STRING: Final = TopicDescription("std_msgs/String", MD5, "string data\n")
LATCHED: Final = TopicDescription("std_msgs/String", MD5, "string data\n", latching=True)


def node(core: RosCore, name: str, **options: object) -> Node:
    """A node at a core of a test."""
    return Node(name, master_uri=core.uri, environment=RosEnvironment(), **options)  # type: ignore[arg-type]


class RawSubscriber:
    """A bare connection to a TCPROS server.

    Attributes:
        made: Those that are closed at the end of a test of this folder.
    """

    made: ClassVar[list[RawSubscriber] | None] = None

    def __init__(self, sock: socket.socket) -> None:
        if self.made is not None:
            self.made.append(self)
        self.sock = sock
        self.data = b""

    @classmethod
    async def dial(cls, address: tuple[str, int], *, buffer: int = 0) -> Self:
        """Connect and send nothing; ``buffer`` makes the receive buffer small."""
        sock = socket.socket()
        if buffer:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer)
        sock.setblocking(False)
        try:
            await asyncio.get_running_loop().sock_connect(sock, address)
        except OSError:
            sock.close()
            raise
        return cls(sock)

    @classmethod
    async def connect(cls, address: tuple[str, int], *, buffer: int = 0, **fields: str) -> Self:
        """Connect and send a header: that of a subscriber of ``/t``, with changes."""
        made = await cls.dial(address, buffer=buffer)
        header = {"topic": "/t", "callerid": "/s", "md5sum": MD5, "type": "std_msgs/String", **fields}
        await made.send(encode_header({key: value for key, value in header.items() if value}))
        return made

    async def send(self, data: bytes) -> None:
        """Send bytes."""
        await asyncio.get_running_loop().sock_sendall(self.sock, data)

    async def _more(self) -> None:
        async with asyncio.timeout(DEADLINE):
            chunk = await asyncio.get_running_loop().sock_recv(self.sock, 1 << 20)
        if not chunk:
            raise EOFError
        self.data += chunk

    async def header(self) -> Mapping[str, str]:
        """The header that comes."""
        while True:
            fields, consumed, _ = parse_header(self.data)
            if fields is not None:
                self.data = self.data[consumed:]
                return fields
            await self._more()

    async def message(self) -> bytes:
        """The next message, without its length."""
        while len(self.data) < 4 or len(self.data) < 4 + LENGTH.unpack_from(self.data)[0]:
            await self._more()
        end = 4 + LENGTH.unpack_from(self.data)[0]
        message, self.data = self.data[4:end], self.data[end:]
        return message

    async def ended(self) -> bool:
        """Wait for the other side to close; whether nothing came before."""
        with contextlib.suppress(ConnectionError):
            try:
                await self._more()
            except EOFError:
                return True
            return False
        return True

    def close(self) -> None:
        """Close."""
        self.sock.close()


class RawServer:
    """A listening socket whose connections are accepted by hand."""

    def __init__(self) -> None:
        self._socket = socket.create_server(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self.port: int = self._socket.getsockname()[1]
        self.links: list[RawSubscriber] = []

    async def accept(self) -> RawSubscriber:
        """The next connection."""
        async with asyncio.timeout(DEADLINE):
            sock, _ = await asyncio.get_running_loop().sock_accept(self._socket)
        sock.setblocking(False)
        self.links.append(RawSubscriber(sock))
        return self.links[-1]

    def close(self) -> None:
        """Close the port and all connections."""
        self._socket.close()
        for link in self.links:
            link.close()


class RawPublisher(RawServer):
    """A publisher's slave API, with its listening socket."""

    def __init__(self, description: TopicDescription = STRING) -> None:
        super().__init__()
        self.description = description
        self.answer: XmlRpcValue = None
        self.asked: list[tuple[XmlRpcValue, ...]] = []
        self._server = XmlRpcServer(self._call)

    async def __aenter__(self) -> Self:
        await self._server.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._server.close()
        self.close()

    @property
    def uri(self) -> str:
        """The slave API."""
        return f"http://127.0.0.1:{self._server.port}/"

    def _call(self, method: str, params: tuple[XmlRpcValue, ...]) -> XmlRpcValue:
        assert method == "requestTopic"
        self.asked.append(params)
        return self.answer if self.answer is not None else [1, "ready", ["TCPROS", "127.0.0.1", self.port]]

    async def serve(self) -> tuple[RawSubscriber, Mapping[str, str]]:
        """The next connection and its header, answered."""
        link = await self.accept()
        fields = await link.header()
        await link.send(encode_header(publisher_header("/t", "/p", self.description)))
        return link, fields
