"""A web app of another site in a real Chromium: it reads the API where its origin is listed."""

from __future__ import annotations

import pytest
from aiohttp import web

from lab.bed.chromium import BINARY, Chromium
from tests.web.server.test_server import TOKEN, running
from tests.web.snapshots import FULL


async def app(_request: web.Request) -> web.Response:
    return web.Response(text="<!doctype html><title>app</title>", content_type="text/html")


async def test_a_listed_app_reads_with_the_token_and_others_do_not() -> None:
    if BINARY is None:
        pytest.skip("Chromium is not installed: apt install chromium")
    apps = web.Application()
    apps.router.add_get("/", app)
    runner = web.AppRunner(apps)
    await runner.setup()
    try:
        await web.TCPSite(runner, "127.0.0.1", 0).start()
        port = runner.addresses[0][1]
        listed, unlisted = f"http://127.0.0.1:{port}", f"http://localhost:{port}"
        async with running(TOKEN, frozenset({listed})) as site, Chromium() as page:
            url = f"http://127.0.0.1:{site.server.port}/api/v1/peers"
            headers = f"{{ Authorization: 'Bearer {TOKEN}' }}"
            read = (
                f"fetch({url!r}, {{ headers: {headers} }}).then((answer) => answer.json())"
                ".then((peers) => peers.map((peer) => peer.name).join(), (error) => error.name)"
            )
            for origin, expected in (
                (listed, ",".join(peer.name for peer in FULL.peers)),
                (unlisted, "TypeError"),
            ):
                await page.goto(origin)
                await page.wait(f"location.origin === {origin!r} && document.readyState === 'complete'")
                assert await page.run(read) == expected
            assert await site.refused("origin") == 1, "the browser asked, and sent no token"
    finally:
        await runner.cleanup()
