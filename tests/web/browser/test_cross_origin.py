"""Pages of other origins, and what the pages compute."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from typing import Final

import pytest
from aiohttp import web

from lab.bed.chromium import Browser, Chromium
from tests.interop import npm
from tests.web.server.test_server import TOKEN, running


async def test_a_link_with_the_token_on_another_site_opens_the_page_for_good(browser: Browser) -> None:
    async with running(TOKEN) as site, Chromium(browser=browser) as page:
        server = f"http://127.0.0.1:{site.server.port}/"

        async def links(_request: web.Request) -> web.Response:
            text = (
                f"<!doctype html><a id=bare href={server}>bare</a><a id=token href={server}?token={TOKEN}>token</a>"
            )
            return web.Response(text=text, content_type="text/html")

        apps = web.Application()
        apps.router.add_get("/", links)
        runner = web.AppRunner(apps)
        await runner.setup()
        try:
            await web.TCPSite(runner, "127.0.0.1", 0).start()
            elsewhere = f"http://localhost:{runner.addresses[0][1]}/"
            for link, shown in (("bare", "needs a token"), ("token", ""), ("bare", "")):
                await page.goto(elsewhere)
                await page.wait(f"location.href === {elsewhere!r} && document.readyState === 'complete'")
                await page.run(f"document.getElementById('{link}').click()")
                await page.wait(f"location.href.startsWith({server!r}) && document.readyState === 'complete'")
                if shown:
                    assert shown in await page.run("document.body.innerText")
                    assert await page.run("document.contentType") == "text/html"
                    continue
                assert await page.run("document.title") == "RMPA"
                assert await page.run("location.search") == ""  # the token has left the address
                assert await page.run(f"fetch({server!r} + 'api/v1/peers').then((answer) => answer.status)") == 200
        finally:
            await runner.cleanup()


PAGES: Final = Path(__file__).parents[1] / "pages"
STATIC: Final = Path(__file__).parents[3] / "src/rmpa/web/static"


@pytest.mark.skipif(bool(npm.why_not()), reason=npm.why_not())
def test_what_the_pages_compute(tmp_path: Path) -> None:
    (tmp_path / "package.json").write_text('{"type": "module"}')
    shutil.copytree(STATIC, tmp_path / "static")
    file = shutil.copy(PAGES / "pages.test.mjs", tmp_path)
    done = subprocess.run(["node", "--test", file], check=False, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr
