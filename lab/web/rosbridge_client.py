"""A rosbridge client that calls services, one after the other."""

from __future__ import annotations

import itertools
import json
import time
from typing import TYPE_CHECKING, Any, Self

from lab.bed.processes import BedError
from lab.web.websocket import TEXT, WebSocket

if TYPE_CHECKING:
    from collections.abc import Mapping


class RosbridgeClient:
    """One client; a context manager.

    Args:
        port: Of the server, on this machine.
        path: With the token, where one is asked for.
    """

    def __init__(self, port: int, path: str = "/") -> None:
        self._socket = WebSocket(port, path)
        self._numbers = itertools.count(1)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def call(self, service: str, arguments: Mapping[str, Any] | None = None) -> tuple[float, Any]:
        """Call a service; returns the milliseconds until its response was here as text, and its values.

        Raises:
            BedError: The call failed, or the server closed the connection.
            Deadline: No response came in time.
        """
        mid = f"call{next(self._numbers)}"
        request = json.dumps({"op": "call_service", "id": mid, "service": service, "args": arguments or {}})
        began = time.perf_counter()
        self._socket.send(request)
        while True:
            frame = self._socket.receive()
            took = (time.perf_counter() - began) * 1e3
            if frame.opcode != TEXT:
                continue
            answer = json.loads(frame.payload)
            if answer.get("op") == "service_response" and answer.get("id") == mid:
                if not answer.get("result", True):
                    raise BedError(f"{service}: {str(answer.get('values'))[:300]}")
                return took, answer.get("values")
