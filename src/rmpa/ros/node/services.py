"""The services of a ``Node``: ``Service`` serves one, ``ServiceClient`` calls one."""

from __future__ import annotations

import asyncio
import inspect
import logging
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

from rmpa.config import limits
from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.ros.node.service_client import ServiceConnection, ServiceFailed
from rmpa.ros.node.service_server import ServiceCall, ServiceEndpoint
from rmpa.ros.types.messages import MessageError
from rmpa.ros.wire.tcpros import ANY, printable

if TYPE_CHECKING:
    from rmpa.ros.types.messages import MessageType
    from rmpa.ros.types.service_types import ServiceType
    from rmpa.ros.wire.tcpros import Buffer

_log = logging.getLogger(__name__)

Handler = Callable[[Any], "Awaitable[Any] | Any"]


class Service:
    """A service of a ``Node``; made by ``Node.advertise_service``.

    Args:
        name: The global name.
        caller_id: The node's name.
        kind: The type.
        handler: Gets the request as an object; returns the response as an object or as plain values, at once or as an
            awaitable. An exception becomes the client's error.
        timeout: Seconds for a call.
        on_close: Unregisters the service.
        raw: Whether the handler gets the request's bytes, and returns the response's.
    """

    def __init__(
        self,
        name: str,
        caller_id: str,
        kind: ServiceType,
        handler: Handler,
        timeout: float,
        on_close: Callable[[str], Awaitable[None]],
        *,
        raw: bool = False,
    ) -> None:
        self.name = name
        self.kind = kind
        self._raw = raw
        self._handler = handler
        self._on_close = on_close
        self._tasks: set[asyncio.Task[None]] = set()
        self.endpoint = ServiceEndpoint(name, caller_id, self._serve, description=kind.describe(), timeout=timeout)

    async def close(self) -> None:
        """Unregister the service; calls under way get an error."""
        await self._on_close(self.name)

    def _serve(self, call: ServiceCall) -> None:
        try:
            result = self._handler(bytes(call.request) if self._raw else self.kind.request.deserialize(call.request))
        except Exception as error:  # noqa: BLE001 - the top of the user's code
            self._failed(call, error)
            return
        if not inspect.isawaitable(result):
            self._reply(call, result)
            return
        task = asyncio.get_running_loop().create_task(self._respond(call, result), name=f"call of {self.name}")
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

        def gone() -> None:
            task.cancel()

        call.on_gone = gone

    async def _respond(self, call: ServiceCall, result: Awaitable[Any]) -> None:
        try:
            self._reply(call, await result)
        except Exception as error:  # noqa: BLE001 - the top of the user's code, as a task
            self._failed(call, error)

    def _reply(self, call: ServiceCall, result: Any) -> None:
        try:
            call.reply(True, result if self._raw else _serialize(self.kind.response, result))
        except MessageError as error:
            self._failed(call, error)

    def _failed(self, call: ServiceCall, error: Exception) -> None:
        if not isinstance(error, RmpaError):
            _log.error("! %s: a call of %s failed", self.name, printable(call.caller_id), exc_info=error)
        text = str(error)
        call.fail(text if isinstance(error, RmpaError) and text else f"{type(error).__name__}: {text}")


class ServiceClient:
    """Calls one service over one connection, one call at a time; made by ``Node.connect_service``.

    Args:
        connection: To its server.
        kind: The type.
    """

    def __init__(self, connection: ServiceConnection, kind: ServiceType) -> None:
        self.connection = connection
        self.kind = kind

    @property
    def closed(self) -> bool:
        """Whether either side has closed the connection."""
        return self.connection.closed

    async def call(
        self,
        request: object = None,
        timeout: float | None = limits.SERVICE_TIMEOUT,  # noqa: ASYNC109 - the message names it
    ) -> Any:
        """Call the service.

        Args:
            request: As an object, or as plain values (see ``MessageType.make``).
            timeout: Seconds; ``None`` waits for ever.

        Returns:
            The response as an object.

        Raises:
            MessageError: The request does not fit the type, or the response is not one.
            PeerRefused: The server answers with an error.
            ServiceFailed: The server disconnected, or did not answer in time.
        """
        ok, body = await self.connection.call(_serialize(self.kind.request, request), timeout)
        if not ok:
            raise PeerRefused(f"service {self.connection.service}", str(bytes(body), "utf-8", "replace"))
        return self.kind.response.deserialize(body)

    def close(self) -> None:
        """Close the connection."""
        self.connection.close()


def _serialize(kind: MessageType, value: object) -> Buffer:
    return kind.serialize(kind.given(value))


async def probe(uri: str, service: str, caller_id: str, timeout: float) -> ServiceConnection:  # noqa: ASYNC109
    """Ask a server for its description; returns the closed connection with ``description`` and ``caller_id``.

    Raises:
        RmpaError: As ``ServiceConnection.open``.
    """
    connection = await ServiceConnection.open(uri, service, caller_id, md5sum=ANY, probe=True, timeout=timeout)
    connection.close()
    return connection


__all__ = ["Handler", "Service", "ServiceClient", "ServiceFailed", "probe"]
