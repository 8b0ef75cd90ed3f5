"""A Zenoh router and sessions on loopback, for tests of the gateway."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import AsyncIterator

import pytest

from rmpa.gateway.zenoh.config import ZenohConfig
from rmpa.gateway.zenoh.session import OpenSession, open_session
from rmpa.gateway.zenoh.threads import QueuedPublisher

pytest.importorskip("zenoh", reason="the extra rmpa[zenoh] is not installed")


def free_port() -> int:
    """A TCP port of 127.0.0.1 that is free now."""
    with contextlib.closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def put(publisher: QueuedPublisher, payload: bytes, attachment: bytes = b"") -> None:
    """Publish one message."""
    publisher.put_all([(payload, attachment)])


class ZenohBed:
    """A router, and sessions that are its clients; ``bed`` opens and closes it."""

    def __init__(self) -> None:
        self.port = free_port()
        self.endpoint = f"tcp/127.0.0.1:{self.port}"
        self.router: OpenSession | None = None
        self._opened: list[OpenSession] = []

    async def start_router(self) -> OpenSession:
        """Open the router, or open it again after ``stop_router``."""
        self.router = await open_session(ZenohConfig("router", listen=(self.endpoint,)))
        return self.router

    async def stop_router(self) -> None:
        """Close the router; its clients try to reach it until it is back."""
        if self.router is not None:
            router, self.router = self.router, None
            await router.close()

    async def session(self) -> OpenSession:
        """Open one more client of the router."""
        opened = await open_session(ZenohConfig(connect=(self.endpoint,)))
        self._opened.append(opened)
        return opened

    async def close(self) -> None:
        """Close all sessions, and the router last."""
        for opened in self._opened:
            await opened.close()
        await self.stop_router()


@contextlib.asynccontextmanager
async def bed() -> AsyncIterator[ZenohBed]:
    """A router that runs; everything is closed at the end."""
    made = ZenohBed()
    try:
        await made.start_router()
        yield made
    finally:
        await made.close()
