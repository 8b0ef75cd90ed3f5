"""The client of the control socket for asyncio; the blocking one is ``observe.control_client``."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Self, TypeVar

from rmpa.core.errors import UnreachableError
from rmpa.observe import limits
from rmpa.observe.control import ControlRequest
from rmpa.observe.control_client import START_ONE, read_reply

if TYPE_CHECKING:
    from pathlib import Path
    from types import TracebackType

_T = TypeVar("_T")


class ControlStream:
    """One connection to an agent, made by ``open``; a context manager; one call at a time.

    Args:
        path: The agent's socket.
        reader: Of the connection.
        writer: Likewise.
    """

    def __init__(self, path: Path, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.path = path
        self._reader = reader
        self._writer = writer

    @classmethod
    async def open(cls, path: Path) -> Self:
        """Connect.

        Raises:
            UnreachableError: No agent accepts the connection.
        """
        try:
            reader, writer = await asyncio.open_unix_connection(path, limit=limits.CONTROL_REPLY_MAX)
        except OSError as error:
            raise UnreachableError("agent", f"{path} ({error.strerror})", START_ONE) from None
        return cls(path, reader, writer)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.close()

    async def call(
        self,
        op: str,
        type: type[_T],  # noqa: A002 - as msgspec calls it
        *,
        timeout: float = limits.CONTROL_CALL_TIMEOUT,  # noqa: ASYNC109 - the error says what did not come
        **args: object,
    ) -> _T:
        """Send a request, and wait for the reply; a reply with a long text is none that this client reads.

        Args:
            op: The name of the operation (``observe.operations.REPLIES``).
            type: The type of its value.
            timeout: Seconds.
            args: Its arguments.

        Raises:
            PeerRefused: The agent refused, and said why.
            UnreachableError: It closed the connection, or did not reply in time.
            RemoteProtocolError: Its value has another type.
        """
        self._writer.write(ControlRequest(op, args).serialize())
        try:
            async with asyncio.timeout(timeout):
                line = await self._reader.readline()
        except TimeoutError:
            raise UnreachableError("agent", f"{self.path} in time", "is it stopped? see its log") from None
        except (OSError, ValueError) as error:  # ValueError: the line is too long
            raise UnreachableError("agent", f"{self.path} ({error})", START_ONE) from None
        return read_reply(self.path, op, line, type).value
