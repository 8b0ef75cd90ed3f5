"""A headless Chromium, driven by the DevTools protocol: real pages, keys, sizes and colour schemes in tests."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self

from lab.bed.http_client import http_client
from lab.bed.namespaces import MACHINE, Host

if TYPE_CHECKING:
    from collections.abc import Iterator
    from types import TracebackType


# The program, or ``None``: then the tests of the pages are skipped.
BINARY = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
_NO_IPV6: Final = "/proc/sys/net/ipv6/conf/all/disable_ipv6"
FLAGS = (
    "--headless=new",
    "--disable-gpu",
    "--no-first-run",
    "--disable-extensions",
    "--disable-background-networking",
    "--hide-scrollbars",
    "--remote-debugging-port=0",
)
DEADLINE = 30.0
KEYS = {"Enter": 13, "Escape": 27, "ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40, "Tab": 9}


class PageError(AssertionError):
    """A script failed, or what was waited for did not come."""


class Browser(NamedTuple):
    """A browser that runs: its process, and the port of its DevTools."""

    process: subprocess.Popen[bytes]
    port: int


@contextlib.contextmanager
def running_browser(host: Host = MACHINE) -> Iterator[Browser]:
    """Run a browser with a profile of its own, which several ``Chromium`` may have pages of; it blocks.

    Args:
        host: Where it runs.
    """
    assert BINARY is not None
    if host.namespace:
        # A new interface has its IPv6 address a second later, and what a page loads then is given up: the network is
        # another one (ERR_NETWORK_CHANGED).
        subprocess.run(host.command(["sh", "-c", f"echo 1 > {_NO_IPV6}"]), check=False, stderr=subprocess.DEVNULL)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        flags = [*FLAGS, f"--user-data-dir={profile}"]
        if os.geteuid() == 0:
            flags.append("--no-sandbox")
        process = subprocess.Popen(
            host.command([BINARY, *flags, "about:blank"]),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            process_group=0,
        )
        try:
            yield Browser(process, _port(Path(profile, "DevToolsActivePort"), process))
        finally:
            process.terminate()
            try:
                process.wait(DEADLINE)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _port(path: Path, process: subprocess.Popen[bytes]) -> int:
    deadline = time.monotonic() + DEADLINE
    while not (path.exists() and path.read_text().count("\n")):
        if process.poll() is not None or time.monotonic() > deadline:
            raise PageError(f"Chromium does not say its port; it ended with {process.returncode}")
        time.sleep(0.05)
    return int(path.read_text().splitlines()[0])


class Chromium:
    """One page, with cookies and storage of its own; an asynchronous context manager.

    Args:
        host: Where the browser runs.
        browser: Has the page; one of its own unless it is given.

    Attributes:
        errors: What the page's console says of errors, also of what the CSP blocked, and dialogs that it opened.
    """

    def __init__(self, host: Host = MACHINE, browser: Browser | None = None) -> None:
        self.errors: list[str] = []
        self._host = host
        self._browser = browser
        self._numbers = itertools.count(1)
        self._replies: dict[int, asyncio.Future[Any]] = {}
        self._session: dict[str, str] = {}

    async def __aenter__(self) -> Self:
        self._stack = contextlib.AsyncExitStack()
        try:
            if self._browser is None:
                running = running_browser(self._host)
                self._browser = await asyncio.to_thread(running.__enter__)
                self._stack.push_async_callback(asyncio.to_thread, running.__exit__, None, None, None)
            http = await self._stack.enter_async_context(http_client(self._host))
            async with http.get(f"http://127.0.0.1:{self._browser.port}/json/version") as response:
                url = (await response.json())["webSocketDebuggerUrl"]
            self._socket = await self._stack.enter_async_context(http.ws_connect(url, max_msg_size=0))
            reader = asyncio.create_task(self._read())
            self._stack.callback(reader.cancel)
            context = await self.send("Target.createBrowserContext", disposeOnDetach=True)
            page = await self.send("Target.createTarget", url="about:blank", **context)
            attached = await self.send("Target.attachToTarget", targetId=page["targetId"], flatten=True)
            self._session = {"sessionId": attached["sessionId"]}
            for domain in ("Page", "Runtime", "Log"):
                await self.send(f"{domain}.enable")
            await self.send("Emulation.setFocusEmulationEnabled", enabled=True)  # seen, whatever else is opened
        except BaseException:
            await self._stack.aclose()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._stack.aclose()

    async def kill(self) -> None:
        """``kill -9``: the browser and its processes."""
        assert self._browser is not None
        os.killpg(self._browser.process.pid, signal.SIGKILL)
        await asyncio.to_thread(self._browser.process.wait)

    async def _read(self) -> None:
        async for frame in self._socket:
            message = frame.json()
            if "id" in message:
                reply = self._replies.pop(message["id"], None)
                if reply and not reply.done():
                    reply.set_result(message)
            elif message["method"] == "Runtime.exceptionThrown":
                details = message["params"]["exceptionDetails"]
                self.errors.append(str(details.get("exception", {}).get("description", details["text"])))
            elif message["method"] == "Log.entryAdded" and message["params"]["entry"]["level"] == "error":
                self.errors.append(str(message["params"]["entry"]["text"]))
            elif message["method"] == "Runtime.consoleAPICalled" and message["params"]["type"] == "error":
                self.errors.append(str(message["params"]["args"]))
            elif message["method"] == "Page.javascriptDialogOpening":
                self.errors.append(f"a dialog: {message['params']['message']}")
                answer = {"method": "Page.handleJavaScriptDialog", "params": {"accept": True}}
                await self._socket.send_json({"id": next(self._numbers), **answer, **self._session})

    async def send(self, method: str, **params: Any) -> dict[str, Any]:
        """A command of the DevTools protocol, and its result."""
        number = next(self._numbers)
        reply = self._replies[number] = asyncio.get_running_loop().create_future()
        await self._socket.send_json({"id": number, "method": method, "params": params, **self._session})
        message = await asyncio.wait_for(reply, DEADLINE)
        if "error" in message:
            raise PageError(f"{method}: {message['error']}")
        result: dict[str, Any] = message["result"]
        return result

    async def look(self, width: int = 1440, height: int = 900, *, dark: bool = True, still: bool = True) -> None:
        """The size of the window in CSS pixels, the colour scheme, and whether motion is to be reduced."""
        await self.send(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 600
        )
        features = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"},
                    {"name": "prefers-reduced-motion", "value": "reduce" if still else "no-preference"}]  # fmt: skip
        await self.send("Emulation.setEmulatedMedia", features=features)

    async def goto(self, url: str) -> None:
        """Open an address; ``wait`` says when it is there."""
        await self.send("Page.navigate", url=url)

    async def run(self, script: str) -> Any:
        """The value of a JavaScript expression; a promise is awaited."""
        result = await self.send("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in result:
            details = result["exceptionDetails"]
            raise PageError(f"{script}: {details.get('exception', {}).get('description', details['text'])}")
        return result["result"].get("value")

    async def wait(self, script: str) -> None:
        """Wait until a JavaScript expression is true.

        Raises:
            PageError: It was not within ``DEADLINE``; the text has what the page shows and its errors.
        """
        try:
            async with asyncio.timeout(DEADLINE):
                while True:
                    with contextlib.suppress(PageError):
                        if await self.run(f"Boolean({script})"):
                            return
                    await asyncio.sleep(0.05)
        except TimeoutError:
            text = await self.run("document.body.innerText")
            raise PageError(f"not true: {script}; the page shows {text[:800]!r}, errors {self.errors}") from None

    async def wait_text(self, text: str) -> None:
        """Wait until the page shows a text."""
        await self.wait(f"document.body.innerText.includes({text!r})")

    async def click(self, text: str, within: str = "document") -> None:
        """Press the button of that text as soon as it is there.

        Args:
            text: The whole text of the button.
            within: An expression for the element that has it.
        """
        button = f"[...{within}.querySelectorAll('button')].find((b) => b.textContent === {text!r} && !b.disabled)"
        await self.wait(f"({button})?.click() ?? !!({button})")

    async def press(self, key: str) -> None:
        """Press and release one key."""
        await self.down(key)
        await self.up(key)

    async def down(self, key: str) -> None:
        """Press a key."""
        text = {"text": key} if len(key) == 1 else {"text": "\r"} if key == "Enter" else {}
        code = KEYS.get(key) or ord(key.upper())
        await self.send("Input.dispatchKeyEvent", type="keyDown", key=key, windowsVirtualKeyCode=code, **text)

    async def up(self, key: str) -> None:
        """Release a key."""
        code = KEYS.get(key) or ord(key.upper())
        await self.send("Input.dispatchKeyEvent", type="keyUp", key=key, windowsVirtualKeyCode=code)
