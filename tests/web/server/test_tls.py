"""HTTPS and WSS with the user's certificate; the files of ``tls/`` were made for these tests alone."""

from __future__ import annotations

import asyncio
import ssl
from pathlib import Path
from typing import TYPE_CHECKING

import aiohttp
import pytest

from rmpa.core.errors import ConfigError, StartError
from rmpa.web.server.agent_watch import AgentWatch
from rmpa.web.server.auth import AccessPolicy, own_names
from rmpa.web.server.server import WebServer
from rmpa.web.server.tls import tls_context
from tests.ros.node.peers import DEADLINE
from tests.web.snapshots import FULL as SNAPSHOT

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

FILES = Path(__file__).with_name("tls")
CERT, KEY = str(FILES / "cert.pem"), str(FILES / "key.pem")
TOKEN = "secret-" * 6


@pytest.fixture
async def server() -> AsyncIterator[WebServer]:
    watch = AgentWatch(lambda: SNAPSHOT)
    policy = AccessPolicy(0, own_names(("base",)), TOKEN)
    made = WebServer(watch, policy, "127.0.0.1", tls=tls_context(CERT, KEY))
    await made.start()
    yield made
    await made.close()


async def test_a_page_comes_over_https_and_its_cookie_stays_there(server: WebServer) -> None:
    trusted = ssl.create_default_context(cafile=CERT)
    async with aiohttp.ClientSession(connector=aiohttp.TCPConnector(ssl=trusted)) as session:
        url = f"https://127.0.0.1:{server.port}/?token={TOKEN}"
        async with session.get(url, allow_redirects=False) as response:
            assert response.status == 303
            cookie = response.headers["Set-Cookie"]
            assert "Secure" in cookie
            assert "HttpOnly" in cookie
        headers = {"Authorization": f"Bearer {TOKEN}", "Origin": f"https://127.0.0.1:{server.port}"}
        async with session.get(f"https://127.0.0.1:{server.port}/api/v1/agent", headers=headers) as response:
            assert response.status == 200


async def test_http_at_an_https_port_gets_no_answer_and_harms_nothing(server: WebServer) -> None:
    reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
    writer.write(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
    answer = await asyncio.wait_for(reader.read(), DEADLINE)
    assert b"HTTP" not in answer
    writer.close()
    trusted = ssl.create_default_context(cafile=CERT)
    async with (
        aiohttp.ClientSession() as session,
        session.get(f"https://127.0.0.1:{server.port}/healthz", ssl=trusted) as response,
    ):
        assert response.status == 200


def test_without_a_certificate_it_is_http() -> None:
    assert tls_context("", "") is None


@pytest.mark.parametrize(
    ("cert", "key", "problem"),
    [
        ("", KEY, "key without a certificate"),
        ("/no/such.pem", KEY, "no such file"),
        (CERT, str(FILES / "other.pem"), "cannot be used with its key"),
        (CERT, str(FILES / "encrypted.pem"), "cannot be used with its key"),
        (KEY, KEY, "cannot be used with its key"),
        (CERT, "", "cannot be used with its key"),
    ],
)
def test_files_that_cannot_be_used_are_told(cert: str, key: str, problem: str) -> None:
    with pytest.raises((ConfigError, StartError), match=problem):
        tls_context(cert, key)
