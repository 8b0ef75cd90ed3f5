"""Connected sockets, with TLS on them or not; the streams of a test end with it."""

from __future__ import annotations

import socket
from typing import TYPE_CHECKING

import pytest

from tests.runtime.message_streams import close_all

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from tests.runtime.secure_pairs import SecurePairs


@pytest.fixture
async def sockets() -> AsyncIterator[tuple[socket.socket, socket.socket]]:
    """Both ends of a TCP connection."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        made = socket.create_connection(listener.getsockname()), listener.accept()[0]
    yield made
    close_all(*made)


@pytest.fixture
def tls(sockets: tuple[socket.socket, socket.socket]) -> SecurePairs:
    made: SecurePairs = pytest.importorskip("tests.runtime.secure_pairs").SecurePairs(sockets)
    return made
