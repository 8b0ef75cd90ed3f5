"""What pages of other sites can read: the REST API and /metrics, where their origin is listed (CORS)."""

from __future__ import annotations

import pytest

from rmpa.web.server.app import HEADERS
from tests.web.server.test_server import TOKEN, Site, running

APP = "https://app.example"
LISTED = frozenset({APP})
READ = ("/api/v1/peers", "/metrics", "/healthz")


async def preflight(site: Site, path: str, origin: str) -> tuple[int, dict[str, str]]:
    """What a browser asks before it sends a request with ``Authorization``."""
    asked = {"Access_Control_Request_Method": "GET", "Access_Control_Request_Headers": "authorization"}
    status, headers, body = await site.get(path, "OPTIONS", Origin=origin, **asked)
    assert body == b"" or status != 204
    return status, headers


@pytest.mark.parametrize("path", READ)
async def test_a_listed_site_reads_with_the_token(path: str) -> None:
    async with running(TOKEN, LISTED) as site:
        status, headers = await preflight(site, path, APP)
        assert (status, headers["Access-Control-Allow-Origin"], headers["Vary"]) == (204, APP, "Origin")
        assert headers["Access-Control-Allow-Headers"] == "Authorization"
        assert headers["Access-Control-Allow-Methods"] == "GET, HEAD"
        assert "Access-Control-Allow-Credentials" not in headers
        assert HEADERS.items() <= headers.items()
        status, headers, body = await site.get(path, Origin=APP, Authorization=f"Bearer {TOKEN}")
        assert (status, headers["Access-Control-Allow-Origin"], headers["Vary"]) == (200, APP, "Origin")
        assert body
        assert await site.refused("origin") == await site.refused("method") == 0


async def test_a_listed_site_can_read_why_it_is_refused() -> None:
    async with running(TOKEN, LISTED) as site:
        for path, given, wanted in (
            ("/api/v1/peers", "Bearer wrong", 401),
            ("/api/v1/peers/nobody", f"Bearer {TOKEN}", 404),
            ("/nothing", f"Bearer {TOKEN}", 404),
        ):
            status, headers, _ = await site.get(path, Origin=APP, Authorization=given)
            assert (status, headers["Access-Control-Allow-Origin"]) == (wanted, APP)


@pytest.mark.parametrize("origin", ["https://other.example", "http://app.example", "null", "*"])
async def test_other_sites_read_nothing(origin: str) -> None:
    async with running(TOKEN, LISTED | {"*"}) as site:
        status, headers = await preflight(site, "/api/v1/peers", origin)
        assert status == 403
        assert "Access-Control-Allow-Origin" not in headers
        status, headers, body = await site.get("/api/v1/peers", Origin=origin, Authorization=f"Bearer {TOKEN}")
        assert (status, headers["Vary"]) == (403, "Origin")
        assert "Access-Control-Allow-Origin" not in headers
        assert b"arm" not in body
        assert await site.refused("origin") == 2


async def test_the_pages_themselves_are_not_shared() -> None:
    async with running(origins=LISTED) as site:
        for path in ("/", "/static/app.js"):
            status, headers, _ = await site.get(path, Origin=APP)
            assert status == 200
            assert "Access-Control-Allow-Origin" not in headers
            assert (await preflight(site, path, APP))[0] == 405


async def test_without_listed_sites_no_response_speaks_of_origins() -> None:
    async with running() as site:
        for origin in ({}, {"Origin": f"http://127.0.0.1:{site.server.port}"}):
            _, headers, _ = await site.get("/api/v1/peers", **origin)
            assert not any(name.startswith("Access-Control") or name == "Vary" for name in headers)


async def test_a_request_without_an_origin_is_answered_for_caches_of_listed_sites() -> None:
    async with running(origins=LISTED) as site:
        status, headers, _ = await site.get("/api/v1/peers")
        assert (status, headers["Vary"]) == (200, "Origin")
        assert "Access-Control-Allow-Origin" not in headers
