"""The fake server and Chromium, for the tests of the pages."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator

import pytest
from aiohttp import web

from lab.bed.chromium import BINARY, Browser, Chromium, running_browser
from tests.web.monitor.fake_server import FakeServer


class Site:
    """A served fake server, with a browser.

    Args:
        server: The fake server.
        page: The browser.
        port: Where the server listens, on loopback.
    """

    def __init__(self, server: FakeServer, page: Chromium, port: int) -> None:
        self.server = server
        self.page = page
        self.port = port

    async def open(self, address: str = "", scene: str = "demo") -> Chromium:
        """Open a page, as ``topic/%2Fodom``, in a scene, and wait until it is live."""
        self.server.agent.scene = scene
        await self.page.goto(f"http://127.0.0.1:{self.port}/?{address}#/{address}")
        await self.page.wait("document.querySelector('h1') && window.rmpa.state")
        return self.page


@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    """A browser, of which each test has a page with cookies and storage of its own."""
    if BINARY is None:
        pytest.skip("Chromium is not installed: apt install chromium")
    with running_browser() as running:
        yield running


@pytest.fixture
async def site(browser: Browser) -> AsyncIterator[Site]:
    """The fake server in the scene ``demo``, and a page that has opened nothing yet."""
    server = FakeServer()
    runner = web.AppRunner(server.app(), shutdown_timeout=1.0)
    await runner.setup()
    try:
        await web.TCPSite(runner, "127.0.0.1", 0).start()
        async with Chromium(browser=browser) as page:
            await page.look()
            yield Site(server, page, runner.addresses[0][1])
    finally:
        await runner.cleanup()
