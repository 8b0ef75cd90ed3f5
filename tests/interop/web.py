"""``rmpa web`` of a module as its user starts it, and what its clients see: WebSockets, pages, metrics."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Mapping
from pathlib import Path
from typing import Final, Self

import aiohttp
import pytest
from prometheus_client.parser import text_string_to_metric_families

from lab.bed.agents import RMPA, Agent
from lab.bed.chromium import BINARY, Chromium
from lab.bed.processes import DEADLINE, Process
from rmpa.web.monitor.messages import SUBPROTOCOL
from tests.web.monitor.page import Page

PORT: Final = 8480
needs_browser = pytest.mark.skipif(BINARY is None, reason="Chromium is not installed: apt install chromium")


class Web:
    """One ``rmpa web`` that other hosts reach, and so with a token; it ends with the context.

    Args:
        agent: Of its module; on a host of a lab.
        flags: Further arguments.
        port: Its port.
        environ: Further settings, as ``RMPA_WEB_ORIGINS``.
    """

    def __init__(self, agent: Agent, *flags: str, port: int = PORT, environ: Mapping[str, str] | None = None) -> None:
        argv = ["web", "--listen", "0.0.0.0", "--port", str(port), "--agent", agent.name, *flags]
        env = {**agent.env, **(environ or {})}
        self.process = Process(agent.host.command([RMPA, *argv]), env=env, name=f"rmpa web {agent.name}")
        self.host = f"{agent.host.address}:{port}"
        self.token = ""

    def __enter__(self) -> Self:
        try:
            file = self.process.wait_for(r"(?:is kept in|need the token of) ([^;]+)")[1]
            self.token = Path(file).read_text(encoding="ascii").strip()
        except BaseException:
            self.process.end()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.process.end()
        print(self.process.output[-8000:])  # of a test that fails

    @property
    def url(self) -> str:
        """Without a path."""
        return f"http://{self.host}"

    @property
    def bearer(self) -> dict[str, str]:
        """The header that shows the token."""
        return {"Authorization": f"Bearer {self.token}"}

    async def open(self, page: Chromium, address: str = "") -> None:
        """Follow the URL with the token, as a user does, to one of the pages, such as ``topic/%2Fodom``."""
        await page.goto(f"{self.url}/?token={self.token}#/{address}")
        await page.wait("document.querySelector('h1') && window.rmpa?.state && !location.search")

    @contextlib.asynccontextmanager
    async def monitor(self, http: aiohttp.ClientSession) -> AsyncIterator[Page]:
        """A WebSocket as a page has one, that has its first state."""
        async with http.ws_connect(
            f"ws://{self.host}/monitor", protocols=(SUBPROTOCOL,), headers=self.bearer
        ) as made:
            page = Page(made)
            await page.sees(lambda: page.state)
            yield page

    async def counts(self, http: aiohttp.ClientSession, name: str, label: str) -> dict[str, float]:
        """The samples of a metric that are not 0, by one label."""
        async with http.get(f"{self.url}/metrics", headers=self.bearer) as response:
            assert response.status == 200, await response.text()
            text = await response.text()
        families = text_string_to_metric_families(text)
        found = (sample for family in families for sample in family.samples if sample.name == name)
        return {sample.labels[label]: sample.value for sample in found if sample.value}

    async def wait_counts(
        self, http: aiohttp.ClientSession, name: str, label: str, fit: Callable[[dict[str, float]], bool]
    ) -> None:
        """Wait until a metric has certain samples."""
        found: dict[str, float] = {}
        try:
            async with asyncio.timeout(DEADLINE):
                while not fit(found := await self.counts(http, name, label)):
                    await asyncio.sleep(0.1)
        except TimeoutError:
            raise AssertionError(f"{name}: {found}") from None
