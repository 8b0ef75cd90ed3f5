"""The demo's web page: its address comes first, it shows the modules, and its joystick drives the robot."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import socket
import sys
from pathlib import Path

import pytest

from lab.bed.processes import Process
from rmpa.web.monitor.messages import SUBPROTOCOL
from tests.examples.test_demo import DEMO, all_linked, flows, views, wait_for_view

pytest.importorskip("aiohttp", reason="the libraries of rmpa[web] are not installed")

import aiohttp

from tests.web.monitor.page import Page

DEADLINE = 30.0
# Of the Turtlebot, m/s.
FULL_SPEED = 0.65
pytestmark = pytest.mark.timeout(120)


def modules(page: Page) -> dict[str, str]:
    return {name: module["state"] for name, module in page.state.get("modules", {}).items()}


async def test_its_page_shows_the_modules_and_drives_the_robot(tidy: dict[str, str]) -> None:
    with Process([sys.executable, DEMO, "--json"], env=tidy, name="demo") as demo:
        await asyncio.to_thread(wait_for_view, demo, lambda view: all_linked(view) and flows(view), "messages")
        url = json.loads(demo.output.splitlines()[0])["web"]
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/\?token=[\w-]+", url)
        browser = aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True))  # of an address, not a name
        async with browser, browser.get(url) as page:
            assert page.status == 200
            address = str(page.url)
            assert "token" not in address, "it has become a cookie"
            async with browser.ws_connect(f"{address}monitor", protocols=(SUBPROTOCOL,)) as connection:
                await watch_and_drive(Page(connection), demo, tidy)
        assert await asyncio.to_thread(demo.interrupt) == 0, demo.output


async def watch_and_drive(page: Page, demo: Process, env: dict[str, str]) -> None:
    await page.sees(lambda: modules(page) == {"pc": "here", "joystick": "up", "velocity": "up", "base": "up"})
    assert page.hello["agent"] == "pc"
    assert set(page.hello["may"]) == {"control", "drive", "view"}
    await page.sees(lambda: "base>pc" in page.state["flows"] and "base:/base" in page.state["resources"])
    # Without the module that computes the orders, the joystick of the page gives them.
    with Process([sys.executable, DEMO, "kill", "velocity"], env=env, name="kill velocity") as kill:
        assert await kill.ended() == 0, kill.output
    await page.sees(lambda: modules(page)["velocity"] != "up")
    async with asyncio.timeout(DEADLINE):
        while views(demo)[-1]["pose"]["speed"] != FULL_SPEED:
            await page.drive(1.0, topic="/velocity_order")
            await asyncio.sleep(0.1)  # as a held joystick does
    await page.send("release", hold=1)
    stopped = lambda view: view["pose"]["speed"] == 0  # noqa: E731
    await asyncio.to_thread(wait_for_view, demo, stopped, "a stop")


def test_another_port_is_taken_where_8480_is_in_use(tidy: dict[str, str]) -> None:
    with socket.socket() as other:
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        with contextlib.suppress(OSError):  # in use already: as good
            other.bind(("127.0.0.1", 8480))
            other.listen()
        with Process([sys.executable, DEMO, "--seconds", "0.1"], env=tidy, name="demo") as demo:
            assert demo.wait(60) == 0, demo.output
    told = re.fullmatch(r"In a browser: http://127\.0\.0\.1:(\d+)/\?token=[\w-]+", demo.output.splitlines()[0])
    assert told, demo.output
    assert int(told[1]) != 8480


def test_without_the_extra_it_says_how_to_get_it(tidy: dict[str, str], tmp_path: Path) -> None:
    place = tmp_path / "site"
    place.mkdir()
    (place / "sitecustomize.py").write_text("import sys\nsys.modules['aiohttp'] = None\n", encoding="utf-8")
    env = {**tidy, "PYTHONPATH": str(place)}
    with Process([sys.executable, DEMO, "--seconds", "0.1", "--json"], env=env, name="demo") as demo:
        assert demo.wait(60) == 0, demo.output
    problem = re.compile(
        r"rmpa web: aiohttp not installed; run \S+/python3? -m pip install 'rmpa\[web\]' \[extra-missing\]"
    )
    first = json.loads(demo.output.splitlines()[0])
    assert first["web"] is None
    assert problem.fullmatch(first["problem"])
