"""A blocking WebSocket client by the library ``websockets``, whose errors are the bed's."""

from __future__ import annotations

from typing import Final, Self

from websockets.exceptions import WebSocketException
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from lab.bed.processes import BedError, Deadline

# Seconds for the handshake, and for a message that a caller waits for.
_TIMEOUT: Final = 30.0


class WebSocket:
    """One connection; a context manager.

    Args:
        port: Of the server, on this machine.
        path: With the query.
        protocol: The subprotocol that is offered; empty for none.

    Raises:
        BedError: The server refuses.
    """

    def __init__(self, port: int, path: str = "/", protocol: str = "") -> None:
        offered = [Subprotocol(protocol)] if protocol else None
        uri = f"ws://127.0.0.1:{port}{path}"
        try:
            self._client = connect(
                uri, subprotocols=offered, compression=None, max_size=None, open_timeout=_TIMEOUT, ping_interval=None
            )
        except (WebSocketException, OSError) as error:
            raise BedError(f"the web server refuses {path}: {error}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close()

    def send(self, data: str | bytes) -> None:
        """Send one message: text, or bytes as a binary one."""
        self._client.send(data)

    def receive(self, timeout: float | None = _TIMEOUT) -> str | bytes:
        """The next message.

        Raises:
            Deadline: None came in time.
            BedError: The server has closed the connection.
        """
        try:
            message: str | bytes = self._client.recv(timeout)
        except TimeoutError:
            raise Deadline(f"the web server sent nothing for {_TIMEOUT:g} s") from None
        except WebSocketException as error:
            raise BedError(f"the server closed the WebSocket: {error}") from None
        return message
