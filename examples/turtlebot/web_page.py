"""The demo's web page: ``rmpa web`` of the pc's agent, on loopback, with a token of its own in its URL.

It is a process beside the four modules: it starts without the agent, shows when that is gone, and finds it again.
Without the libraries of rmpa[web] there is no page, and the demo runs all the same.
"""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING

from child import Child
from ports import port_or_another

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

PORT = 8480
"""As users know it from ``rmpa web``."""
STARTING = 20.0
"""Seconds until it listens; some tenths of a second on a machine that is not busy."""
STARTS_MAX = 3
"""Another program may take the port between our look and its use: so many attempts."""
NOT_INSTALLED = "not installed"
"""What ``rmpa web`` says of libraries that are missing."""


class NoPage(Exception):  # noqa: N818 - it is an answer
    """There is no web page, and why.

    Attributes:
        is_failure: ``False`` where its libraries are not installed, which is the user's choice.
    """

    def __init__(self, text: str, *, is_failure: bool) -> None:
        super().__init__(text)
        self.is_failure = is_failure


class WebPage:
    """``rmpa web`` for the agent ``pc``.

    Args:
        rmpa: The path of the program.
        settings: Its ``rmpa.toml``.
        token: A file for its token, which is made anew at each start.
        taken: Ports that are promised to others.
    """

    def __init__(self, rmpa: str, settings: Path, token: Path, taken: set[int]) -> None:
        self._rmpa = rmpa
        self._settings = settings
        self._token = token
        self._taken = taken
        self.child: Child | None = None

    async def start(self, env: Mapping[str, str], over: asyncio.Event) -> str:
        """Start it and wait until it listens; return its URL, empty if ``over`` was set before.

        Raises:
            NoPage: It has ended.
        """
        starts = 0
        while True:
            starts += 1
            child, url = await self._attempt(env)
            if await _first(url, child, over):
                return url.result() if url.done() else ""
            if starts == STARTS_MAX or not any("in use" in line for line in child.tail):
                words = child.tail[-1].removeprefix("rmpa: ") if child.tail else "rmpa web ended at once"
                raise NoPage(words, is_failure=NOT_INSTALLED not in words)

    async def _attempt(self, env: Mapping[str, str]) -> tuple[Child, asyncio.Future[str]]:
        url: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._token.unlink(missing_ok=True)  # the URL has a token only when it is made
        port = port_or_another(PORT, self._taken)
        command = [self._rmpa, "web", "--agent", "pc", "--port", str(port), "--config", str(self._settings)]
        command += ["--control", "--drive", "--token-file", str(self._token), "--json"]
        self.child = await Child.start(
            "web page", command, env, lambda _: None, piped=False, said=lambda line: _take(line, url)
        )
        return self.child, url


def _take(line: str, url: asyncio.Future[str]) -> None:
    """Read a line of ``rmpa web --json``: where it listens, or why it does not."""
    said = json.loads(line) if line.startswith("{") else {}
    if "url" in said and not url.done():
        url.set_result(said["url"])


async def _first(url: asyncio.Future[str], child: Child, over: asyncio.Event) -> bool:
    """Wait for what comes first; return whether it was not the child's end.

    Raises:
        NoPage: Nothing came in time.
    """
    ended = asyncio.ensure_future(child.process.wait())
    stopped = asyncio.ensure_future(over.wait())
    try:
        done, _ = await asyncio.wait((url, ended, stopped), timeout=STARTING, return_when=asyncio.FIRST_COMPLETED)
    finally:
        ended.cancel()
        stopped.cancel()
    if not done:
        await child.kill()
        raise NoPage(f"rmpa web did not start within {STARTING:g} s", is_failure=True)
    if url.done() or stopped in done:
        return True
    await child.ended()  # with its last words
    return False
