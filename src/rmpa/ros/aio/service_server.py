"""The serving side of a service: ``SlaveNode.add_service`` puts an endpoint behind the node's TCPROS port."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING

from rmpa.core import limits
from rmpa.core.errors import LocalProtocolError
from rmpa.ros.services import ServiceDescription

if TYPE_CHECKING:
    from rmpa.ros.aio.inbound import Inbound
    from rmpa.ros.tcpros import Buffer

_log = logging.getLogger(__name__)

Describe = Callable[[], Awaitable["ServiceDescription | str"]]
Serve = Callable[["ServiceCall"], None]
Respond = Callable[["ServiceCall"], Awaitable["tuple[bool, Buffer]"]]


class ServiceCall:
    """One request, until it is answered.

    Attributes:
        service: The service's name here.
        caller_id: The calling node.
        request: The request's bytes, without a length; belongs to the call and never changes.
        deadline: ``loop.time()`` at which the client gets an error by itself.
        on_gone: Set it to hear that no answer is wanted any more: the client has left, the deadline is over, or the
            service is withdrawn. Called once at the most, and never behind ``reply``.
    """

    __slots__ = ("caller_id", "deadline", "on_gone", "request", "service")

    def __init__(self, service: str, caller_id: str, request: bytes | bytearray, deadline: float) -> None:
        self.service = service
        self.caller_id = caller_id
        self.request = request
        self.deadline = deadline
        self.on_gone: Callable[[], None] | None = None

    @property
    def answered(self) -> bool:
        """Whether an answer has been given, or is not wanted any more."""
        raise NotImplementedError

    def reply(self, ok: bool, body: Buffer) -> None:
        """Answer; ``body`` is the response, or for ``ok=False`` the error's text. The first answer counts."""
        raise NotImplementedError

    def fail(self, text: str) -> None:
        """Answer with an error."""
        self.reply(False, text.encode(errors="replace"))


class ServiceEndpoint:
    """One service of a node: takes its connections, and hands each request over as a ``ServiceCall``.

    Args:
        service: The global name, compared literally.
        caller_id: The serving node's name.
        serve: Called in the loop with each request; answers at once or later by ``call.reply``. What it raises becomes
            the client's error. ``responding(async_function)`` makes one of a coroutine function.
        describe: Asked when the first header comes and nothing is known (``description`` is ``None``); returns the
            description, which is kept, or the text of a refusal, which is not. Connections that come meanwhile wait
            for the same answer.
        description: What is known from the start.
        timeout: Seconds for a call before the client gets an error.
        on_mismatch: ``(fields, text)``: a client with another md5 sum was refused.
    """

    def __init__(
        self,
        service: str,
        caller_id: str,
        serve: Serve,
        describe: Describe | None = None,
        *,
        description: ServiceDescription | None = None,
        timeout: float = limits.SERVICE_TIMEOUT,
        on_mismatch: Callable[[dict[str, str], str], None] | None = None,
    ) -> None:
        self.service = service
        self.caller_id = caller_id
        self.timeout = timeout
        self.description = description
        """What clients are told; ``None`` to have ``describe`` asked at the next header."""
        self.calls = 0
        """Requests taken so far."""
        self.failed = 0
        """Of these, answered with an error."""

    @property
    def connections(self) -> int:
        """Open connections."""
        raise NotImplementedError

    def attach(self, link: Inbound) -> None:
        """Take a connection whose header names this service."""
        raise NotImplementedError

    def withdraw(self, text: str = "") -> None:
        """Close all connections; calls under way get an error with ``text``."""
        raise NotImplementedError


def responding(respond: Respond) -> Serve:
    """A ``serve`` that runs a coroutine function for each call; it is cancelled when the client leaves."""
    raise NotImplementedError
