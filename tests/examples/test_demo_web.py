"""The demo's web page: its address comes first, it shows the modules, and its joystick drives the robot."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import re
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from lab.bed.processes import Process
from rmpa.web.monitor.messages import SUBPROTOCOL
from tests.examples.test_demo import DEMO, all_linked, flows, views, wait_for_view
from tests.web.monitor.patches import apply

aiohttp = pytest.importorskip("aiohttp", reason="the libraries of rmpa[web] are not installed")
DEADLINE = 30.0
# Of the Turtlebot, m/s.
FULL_SPEED = 0.65
pytestmark = pytest.mark.timeout(120)


class Page:
    """What the page at the other end of a WebSocket knows."""

    def __init__(self, connection: Any) -> None:
        self._connection = connection
        self.hello: dict[str, Any] = {}
        self.state: Any = {}

    async def until(self, holds: Callable[[], bool]) -> None:
        """Read, and draw, until something holds."""
        async with asyncio.timeout(DEADLINE):
            while not holds():
                message = await self._connection.receive_json()
                if message["op"] == "hello":
                    self.hello = message
                elif message["op"] in ("state", "patch"):
                    patched = apply(self.state, message["patch"]) if message["op"] == "patch" else message["state"]
                    self.state = patched
                    await self.send(op="ack", n=message["n"])

    async def send(self, **message: object) -> None:
        await self._connection.send_json(message)

    def modules(self) -> dict[str, str]:
        return {name: module["state"] for name, module in self.state.get("modules", {}).items()}


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
    await page.until(lambda: page.modules() == {"pc": "here", "joystick": "up", "velocity": "up", "base": "up"})
    assert page.hello["agent"] == "pc"
    assert set(page.hello["may"]) == {"control", "drive", "view"}
    await page.until(lambda: "base>pc" in page.state["flows"] and "base:/base" in page.state["resources"])
    # Without the module that computes the orders, the joystick of the page gives them.
    with Process([sys.executable, DEMO, "kill", "velocity"], env=env, name="kill velocity") as kill:
        assert await kill.ended() == 0, kill.output
    await page.until(lambda: page.modules()["velocity"] != "up")
    async with asyncio.timeout(DEADLINE):
        numbers = itertools.count(1)
        while views(demo)[-1]["pose"]["speed"] != FULL_SPEED:
            made = {"hold": 1, "n": next(numbers), "at": time.monotonic()}  # one machine, one clock
            await page.send(op="drive", topic="/velocity_order", linear=1, angular=0, **made)
            await asyncio.sleep(0.1)  # as a held joystick does
    await page.send(op="release", hold=1)
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
