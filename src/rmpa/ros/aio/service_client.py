"""The calling side of a service: one connection to its server."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rmpa.core import limits
from rmpa.core.errors import RmpaError
from rmpa.ros.services import ServiceDescription
from rmpa.ros.tcpros import ANY

if TYPE_CHECKING:
    from rmpa.ros.tcpros import Buffer

Done = Callable[["tuple[bool, bytes | bytearray] | RmpaError"], None]


@dataclass(eq=False)
class ServiceFailed(RmpaError):
    """A call got no answer: the server left, was too slow, or broke the protocol.

    Args:
        service: Its name.
        problem: What happened.
        sent: Whether the request may have reached the server; if not, the call can be made again elsewhere.
    """

    service: str
    problem: str
    sent: bool = True

    def __str__(self) -> str:
        """Say which service and what happened."""
        return f"service {self.service}: {self.problem}"


class ServiceConnection:
    """A connection to a service's server; one call at a time.

    Attributes:
        description: What the server says of its service.
        caller_id: The server's node, as it says.
    """

    description: ServiceDescription
    caller_id: str

    @classmethod
    async def open(
        cls,
        uri: str,
        service: str,
        caller_id: str,
        *,
        md5sum: str = ANY,
        persistent: bool = True,
        probe: bool = False,
        timeout: float = limits.SERVICE_OPEN_TIMEOUT,  # noqa: ASYNC109 - the message names it
        on_closed: Callable[[], None] | None = None,
    ) -> ServiceConnection:
        """Connect and exchange headers.

        Args:
            uri: ``rosrpc://host:port``.
            service: The name, as registered there.
            caller_id: Ours.
            md5sum: ``*`` takes any.
            persistent: Whether more than one call will be made.
            probe: Whether no call will be made at all.
            timeout: Seconds for both together.
            on_closed: Called once when the server closes it while no call is under way.

        Raises:
            UnreachableError: Nobody answers there, or not in time.
            PeerRefused: The server answers with an error header, or has another md5 sum.
            RemoteProtocolError: What answers there is not a service's server.
        """
        raise NotImplementedError

    @property
    def closed(self) -> bool:
        """Whether no call can be made any more."""
        raise NotImplementedError

    @property
    def busy(self) -> bool:
        """Whether a call is under way."""
        raise NotImplementedError

    async def call(self, body: Buffer, timeout: float | None = None) -> tuple[bool, bytes | bytearray]:  # noqa: ASYNC109
        """Send a request and wait for its reply: whether it went well, and the response or the error's text.

        Raises:
            ServiceFailed: The server left meanwhile, or did not answer in time (the connection is closed then).
        """
        raise NotImplementedError

    def request(self, body: Buffer, done: Done) -> None:
        """The same without waiting: ``done`` is called once, from the loop or from within ``close``.

        Raises:
            LocalProtocolError: Another call is under way.
            ServiceFailed: It is closed (``sent=False``).
        """
        raise NotImplementedError

    def close(self) -> None:
        """Close at once; a call under way fails."""
        raise NotImplementedError
