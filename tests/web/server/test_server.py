"""A real server, and clients that mean well or ill, over sockets."""

from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest
from prometheus_client.parser import text_string_to_metric_families

from rmpa.core.errors import StartError
from rmpa.web import limits
from rmpa.web.server.access import AccessPolicy, own_names
from rmpa.web.server.agent_watch import AgentWatch
from rmpa.web.server.app import HEADERS, OPENER_POLICY, WebServer
from tests.web.snapshots import Agent

DEADLINE = 30.0
TOKEN = "secret-" * 6


class Site:
    """The server under test, its agent, and a client."""

    def __init__(self, token: str = "", origins: frozenset[str] = frozenset()) -> None:
        self.agent = Agent()
        watch = AgentWatch(self.agent.read, self._later)
        self.server = WebServer(watch, AccessPolicy(0, own_names(("base",)), token, origins), "127.0.0.1")

    def _later(self) -> float:
        self.agent.now += 1.0  # each look at the clock is later than a snapshot's age: nothing is shared
        return self.agent.now

    async def connect(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        return await asyncio.open_connection("127.0.0.1", self.server.port, limit=2**24)

    async def send(self, request: bytes) -> tuple[int, dict[str, str], bytes]:
        reader, writer = await self.connect()
        try:
            writer.write(request)
            return await response(reader)
        finally:
            writer.close()
            await writer.wait_closed()

    async def get(self, path: str, method: str = "GET", **headers: str) -> tuple[int, dict[str, str], bytes]:
        given = {"Host": f"127.0.0.1:{self.server.port}", **{k.replace("_", "-"): v for k, v in headers.items()}}
        lines = "".join(f"{name}: {value}\r\n" for name, value in given.items())
        return await self.send(f"{method} {path} HTTP/1.1\r\n{lines}\r\n".encode())

    async def refused(self, reason: str) -> float:
        """The counter of a reason, as Prometheus sees it."""
        authorization = {"Authorization": f"Bearer {TOKEN}"}
        _, _, body = await self.get("/metrics", **authorization)
        for family in text_string_to_metric_families(body.decode()):
            for sample in family.samples:
                if sample.name == "rmpa_web_refused_total" and sample.labels["reason"] == reason:
                    return sample.value
        raise AssertionError(reason)


async def response(reader: asyncio.StreamReader) -> tuple[int, dict[str, str], bytes]:
    async with asyncio.timeout(DEADLINE):
        head = (await reader.readuntil(b"\r\n\r\n")).decode()
        status, *lines = head.strip().split("\r\n")
        headers = dict(line.split(": ", 1) for line in lines)
        body = await reader.readexactly(int(headers.get("Content-Length", 0)))
    return int(status.split()[1]), headers, body


@asynccontextmanager
async def running(token: str = "", origins: frozenset[str] = frozenset()) -> AsyncIterator[Site]:
    site = Site(token, origins)
    await site.server.start()
    try:
        yield site
    finally:
        await site.server.close()


@pytest.fixture
async def site() -> AsyncIterator[Site]:
    async with running() as made:
        yield made


def detail(body: bytes) -> str:
    text = json.loads(body)["detail"]
    assert isinstance(text, str)
    return text


async def test_each_path_gives_what_it_says(site: Site) -> None:
    for path, kind, part in (
        ("/", "text/html; charset=utf-8", b'href="metrics"'),
        ("/static/style.css", "text/css; charset=utf-8", b"color-scheme"),
        ("/static/app.js", "text/javascript; charset=utf-8", b"import"),
        ("/static/pages/topics.js", "text/javascript; charset=utf-8", b"import"),
        ("/static/vendor/uPlot.js", "text/javascript; charset=utf-8", b"uPlot"),
        ("/metrics", "text/plain; version=0.0.4; charset=utf-8", b"rmpa_up 1.0"),
        ("/healthz", "text/plain; charset=utf-8", b"ok"),
        ("/api/v1/peers/arm", "application/json", b'"name":"arm"'),
        ("/api/v1/topics//image", "application/json", b'"name":"/image"'),
        ("/api/v1/topics/%2Fimage", "application/json", b'"name":"/image"'),
    ):
        status, headers, body = await site.get(path)
        assert (status, headers["Content-Type"]) == (200, kind), path
        assert part in body, path
        assert {**HEADERS, **dict([OPENER_POLICY])}.items() <= headers.items(), path
    assert (await site.get("/metrics", Accept="application/openmetrics-text; version=1.0.0"))[2].endswith(b"# EOF\n")


async def test_the_page_links_only_what_there_is_and_has_no_inline_script(site: Site) -> None:
    page = (await site.get("/"))[2].decode()
    assert page.count("<script") == page.count("<script src=") + page.count('<script type="module" src=') == 2
    assert "style=" not in page
    links = [part.split('"')[0] for name in ("href", "src") for part in page.split(f'{name}="')[1:]]
    assert len(links) >= 5
    for link in links:
        assert (await site.get(f"/{link}"))[0] == 200, link


async def test_head_gives_the_headers_alone(site: Site) -> None:
    reader, writer = await site.connect()
    writer.write(b"HEAD /api/v1/agent HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
    async with asyncio.timeout(DEADLINE):
        answer = await reader.read()
    assert answer.startswith(b"HTTP/1.1 200")
    assert answer.endswith(b"\r\n\r\n")
    writer.close()
    await writer.wait_closed()


async def test_an_agent_that_is_away_is_said_so_and_comes_back(site: Site) -> None:
    site.agent.up = False
    status, headers, body = await site.get("/api/v1/peers")
    assert (status, headers["Content-Type"]) == (503, "application/problem+json")
    assert "rmpa up" in detail(body)
    assert (await site.get("/healthz"))[0] == 503
    assert b"rmpa_up 0.0" in (await site.get("/metrics"))[2]
    site.agent.up = True
    assert (await site.get("/api/v1/peers"))[0] == (await site.get("/healthz"))[0] == 200
    assert b"rmpa_up 1.0" in (await site.get("/metrics"))[2]


async def test_a_token_is_asked_for_and_moves_from_the_url_into_a_cookie() -> None:
    async with running(TOKEN) as site:
        for path in ("/", "/metrics", "/api/v1/peers", "/static/style.css", "/nothing"):
            status, headers, body = await site.get(path)
            assert (status, headers["WWW-Authenticate"]) == (401, 'Bearer realm="rmpa"'), path
            assert "needs a token" in detail(body)
        assert (await site.get("/healthz"))[0] == 200
        assert (await site.get("/api/v1/peers", Authorization="Bearer wrong"))[0] == 401
        assert (await site.get(f"/api/v1/peers?token={TOKEN}"))[0] == 200
        assert (await site.get("/api/v1/peers", Authorization=f"Bearer {TOKEN}"))[0] == 200
        assert await site.refused("token") == 6

        status, headers, _ = await site.get(f"/?token={TOKEN}&dark=1")
        assert (status, headers["Location"]) == (303, "/?dark=1")
        cookie, *attributes = headers["Set-Cookie"].split("; ")
        assert {"HttpOnly", "SameSite=Lax", "Path=/"} <= set(attributes)
        assert (await site.get("/", Cookie=f"other=1; {cookie}"))[0] == 200


async def test_it_only_shows(site: Site) -> None:
    for method in ("POST", "PUT", "DELETE", "PATCH", "OPTIONS"):
        status, headers, body = await site.get("/api/v1/peers", method)
        assert (status, headers["Allow"]) == (405, "GET, HEAD"), method
        assert "only shows" in detail(body)
    status, headers, _ = await site.send(
        b"GET /metrics HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5\r\n\r\nhello"
    )
    assert (status, headers["Connection"]) == (413, "close")
    assert (await site.refused("method"), await site.refused("body")) == (5, 1)


BROKEN = {
    "no HTTP": b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n",
    "a space in a header's name": b"GET / HTTP/1.1\r\nHost : localhost\r\n\r\n",
    "two lengths": b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1\r\nContent-Length: 2\r\n\r\n",
    "a length and chunks": b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1\r\n"
    b"Transfer-Encoding: chunked\r\n\r\n",
    "a long line": b"GET /" + b"a" * limits.WEB_LINE_MAX + b" HTTP/1.1\r\nHost: localhost\r\n\r\n",
    "a long header": b"GET / HTTP/1.1\r\nHost: localhost\r\nA: " + b"a" * 2 * limits.WEB_FIELD_MAX + b"\r\n\r\n",
    "many headers": b"GET / HTTP/1.1\r\nHost: localhost\r\n" + b"A: b\r\n" * limits.WEB_HEADERS_MAX + b"\r\n",
}


async def test_broken_requests_are_refused_and_counted(site: Site) -> None:
    for number, (what, request) in enumerate(BROKEN.items(), start=1):
        assert (await site.send(request))[0] == 400, what
        assert await site.refused("malformed") == number, what
    two_hosts = b"GET / HTTP/1.1\r\nHost: localhost\r\nHost: evil.example\r\n\r\n"
    for request in (b"GET / HTTP/1.0\r\n\r\n", b"GET /\r\n\r\n", two_hosts):
        assert (await site.send(request))[0] == 400
    assert (await site.get("/"))[0] == 200


async def closed(reader: asyncio.StreamReader) -> bytes:
    """What a connection still gives until the server closes it."""
    async with asyncio.timeout(DEADLINE):
        try:
            return await reader.read()
        except ConnectionError:
            return b""


async def test_a_client_that_never_ends_its_headers_is_cut_off(site: Site) -> None:
    reader, writer = await site.connect()
    writer.write(b"GET / HTTP/1.1\r\n")
    chunk = b"A: " + b"a" * 1000 + b"\r\n"
    for _ in range(2 * limits.WEB_REQUEST_MAX // len(chunk)):
        writer.write(chunk)
    await closed(reader)
    writer.close()
    assert await site.refused("oversized") + await site.refused("malformed") == 1


async def test_slow_clients_are_closed_in_time_however_they_trickle(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "WEB_REQUEST_TIMEOUT", 0.3)
    silent, silent_writer = await site.connect()
    slow, slow_writer = await site.connect()

    async def trickle() -> None:
        for byte in b"GET / HTTP/1.1\r\nHost: localhost\r\n" + b"A: b\r\n" * 10_000:
            slow_writer.write(bytes([byte]))
            await asyncio.sleep(0.02)

    trickling = asyncio.create_task(trickle())
    assert await closed(silent) == b""
    assert await closed(slow) == b""
    trickling.cancel()
    for writer in (silent_writer, slow_writer):
        writer.close()
    assert await site.refused("slow_request") == 2


async def test_a_kept_connection_may_be_idle_but_must_not_trickle(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    reader, writer = await site.connect()
    for _ in range(3):
        writer.write(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert (await response(reader))[0] == 200
    monkeypatch.setattr(limits, "WEB_REQUEST_TIMEOUT", 0.1)
    writer.write(b"GET /heal")
    assert await closed(reader) == b""
    writer.close()
    assert await site.refused("slow_request") == 1


async def test_a_client_that_does_not_read_is_cut_off(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "WEB_RESPONSE_TIMEOUT", 0.5)
    with socket.socket() as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        client.connect(("127.0.0.1", site.server.port))
        client.sendall(b"GET /static/vendor/uPlot.js HTTP/1.1\r\nHost: localhost\r\n\r\n" * 500)  # 15 MB of responses
        async with asyncio.timeout(DEADLINE):
            while await site.refused("slow_response") == 0:
                await asyncio.sleep(0.05)
    assert (await site.get("/healthz"))[0] == 200


async def test_requests_without_end_in_a_row_are_cut_off(site: Site) -> None:
    loop = asyncio.get_running_loop()
    with socket.socket() as client:
        client.setblocking(False)
        await loop.sock_connect(client, ("127.0.0.1", site.server.port))
        endless = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n" * 1_000_000
        with pytest.raises(ConnectionError):
            await asyncio.wait_for(loop.sock_sendall(client, endless), DEADLINE)
    assert await site.refused("oversized") == 1


async def test_a_taken_port_is_told(site: Site) -> None:
    other = WebServer(AgentWatch(site.agent.read), AccessPolicy(site.server.port, own_names(())), "127.0.0.1")
    with pytest.raises(StartError, match="--port"):
        await other.start()
    await other.close()


# --- what pages of other sites can read: the REST API and /metrics, where their origin is listed (CORS) ---

MAY_SEND = {"Access-Control-Allow-Methods": "GET, HEAD", "Access-Control-Allow-Headers": "Authorization"}
APP = "https://app.example"
LISTED = frozenset({APP})


async def preflight(site: Site, path: str, origin: str) -> tuple[int, dict[str, str]]:
    """What a browser asks before it sends a request with ``Authorization``."""
    asked = {"Access_Control_Request_Method": "GET", "Access_Control_Request_Headers": "authorization"}
    return (await site.get(path, "OPTIONS", Origin=origin, **asked))[:2]


async def test_a_listed_site_reads_with_the_token_and_why_it_is_refused() -> None:
    async with running(TOKEN, LISTED) as site:
        for path in ("/api/v1/peers", "/metrics", "/healthz"):
            status, headers = await preflight(site, path, APP)
            assert (status, headers["Access-Control-Allow-Origin"], headers["Vary"]) == (204, APP, "Origin")
            assert {**HEADERS, **MAY_SEND}.items() <= headers.items()
            assert "Access-Control-Allow-Credentials" not in headers
        for path, given, wanted in (
            ("/api/v1/peers", TOKEN, 200),
            ("/metrics", TOKEN, 200),
            ("/healthz", TOKEN, 200),
            ("/api/v1/peers", "wrong", 401),
            ("/api/v1/peers/nobody", TOKEN, 404),
            ("/nothing", TOKEN, 404),
        ):
            status, headers, body = await site.get(path, Origin=APP, Authorization=f"Bearer {given}")
            assert (status, headers["Access-Control-Allow-Origin"], headers["Vary"]) == (wanted, APP, "Origin")
            assert body
        assert await site.refused("origin") == await site.refused("method") == 0


@pytest.mark.parametrize("origin", ["https://other.example", "http://app.example", "null", "*"])
async def test_other_sites_read_nothing(origin: str) -> None:
    async with running(TOKEN, LISTED | {"*"}) as site:
        answers = [await site.get("/api/v1/peers", Origin=origin, Authorization=f"Bearer {TOKEN}")]
        answers.append((*await preflight(site, "/api/v1/peers", origin), b""))
        for status, headers, body in answers:
            assert (status, headers["Vary"], headers.get("Access-Control-Allow-Origin")) == (403, "Origin", None)
            assert b"arm" not in body
        assert await site.refused("origin") == 2


async def test_only_what_listed_sites_may_read_speaks_of_origins(site: Site) -> None:
    for origin in ({}, {"Origin": f"http://127.0.0.1:{site.server.port}"}):
        _, headers, _ = await site.get("/api/v1/peers", **origin)
        assert not any(name.startswith("Access-Control") or name == "Vary" for name in headers)
    async with running(origins=LISTED) as sharing:
        for path in ("/", "/static/app.js"):
            status, headers, _ = await sharing.get(path, Origin=APP)
            assert (status, headers.get("Access-Control-Allow-Origin")) == (200, None)
            assert (await preflight(sharing, path, APP))[0] == 405
        status, headers, _ = await sharing.get("/api/v1/peers")  # caches must tell the answers to sites apart
        assert (status, headers["Vary"], headers.get("Access-Control-Allow-Origin")) == (200, "Origin", None)
