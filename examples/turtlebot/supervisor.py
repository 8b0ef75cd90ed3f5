"""Runs the four modules, each with an agent and a core of its own, as children of ours; beside them a web page.

Three are Smart Resources: ``rmpa run`` starts their agents. The pc is an agent (``rmpa up``) and an ordinary node.
With ``sites`` the modules are at two sites, and gateways and a router run beside them.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import shutil
import signal
import socket
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from child import Child, adopt
from ports import free_port
from sites import JOINING, gateway_options, site_of
from web_page import NoPage, WebPage

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Mapping

    from home import Home

MODULES = ("joystick", "velocity", "base", "pc")
GROUP = "239.255.82.77"
HERE = Path(__file__).parent
FAREWELL = 15.0
"""Seconds for a child to end in order before it is killed."""
STARTING = 3.0
"""An agent that ends within so many seconds of its start because of a port gets another port …"""
STARTS_MAX = 3
"""… so often at the most."""
LINE_MAX = 4096


class Refused(Exception):  # noqa: N818 - it is an answer
    """A command that cannot be done, and why."""


@dataclass(slots=True)
class Module:
    """One module: its core's port and its processes."""

    name: str
    core_port: int
    started: float = 0.0
    starts: int = 0
    children: list[Child] = field(default_factory=list)

    @property
    def runs(self) -> bool:
        """Whether any of its processes does."""
        return any(child.runs for child in self.children)


class Supervisor:
    """Starts, watches, kills and ends the modules.

    Args:
        home: Where sockets live.
        joystick: A joystick device for the module joystick, or empty.
        as_json: Whether the pc prints JSON.
        web: Whether there is a web page.
        sites: Whether the modules are at two sites that only gateways join.
    """

    def __init__(
        self, home: Home, *, joystick: str = "", as_json: bool = False, web: bool = True, sites: bool = False
    ) -> None:
        self._web = web
        self._sites = sites
        self._home = home
        self._joystick = joystick
        self._as_json = as_json
        self._taken: set[int] = set()
        self._groups: dict[str, str] = {}
        names = (*MODULES, *JOINING) if sites else MODULES
        self._modules = {name: Module(name, free_port(socket.SOCK_STREAM, self._taken)) for name in names}
        self._router_port = free_port(socket.SOCK_STREAM, self._taken)
        self._untold: list[bytes] | None = []
        self._watching: set[asyncio.Task[None]] = set()
        self._server: asyncio.Server | None = None
        self._killing: list[asyncio.Future[None]] = []
        self._over = asyncio.Event()
        self._page = WebPage(rmpa_program(), home.settings, home.token, self._taken)
        self.failures: list[str] = []
        """What ended by itself, with its last words."""

    async def run(self, seconds: float | None) -> None:
        """Run everything until ``seconds`` are over, ``stop`` is called or the pc's node is gone; end it all."""
        adopt()
        try:
            self._server = await asyncio.start_unix_server(self._serve, self._home.socket, limit=LINE_MAX)
            if self._web:
                await self._open_page()
            await asyncio.gather(*(self._start(module) for module in self._modules.values()))
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._over.wait(), seconds)
        finally:
            await self._end()

    def stop(self) -> None:
        """End in order; at the second call, at once."""
        if self._over.is_set():
            self._killing = [asyncio.ensure_future(child.kill()) for child in self._children()]
        self._over.set()

    # --- the web page -------------------------------------------------------------------------------------------

    async def _open_page(self) -> None:
        """Print the address of the web page, before anything else is shown."""
        told: dict[str, str | None]
        try:
            url = await self._page.start(self._environment("pc"), self._over)
        except NoPage as reason:
            told, text = {"web": None, "problem": str(reason)}, f"No web page: {reason}"
            if reason.is_failure:
                self.failures.append(text)
        else:
            told, text = {"web": url}, f"In a browser: {url}"
        if self._page.child is not None and self._page.child.runs:
            self._follow(self._watch_page(self._page.child), "watch the web page")
        if not self._over.is_set():
            print(json.dumps(told) if self._as_json else text, flush=True)

    async def _watch_page(self, page: Child) -> None:
        status = await page.ended()
        if not page.ours and not self._over.is_set():
            self._failed(page, status, "pc")

    # --- modules ------------------------------------------------------------------------------------------------

    async def _start(self, module: Module) -> None:
        module.children = []
        module.started = time.monotonic()
        module.starts += 1
        started: dict[str, object] = {"event": "started", "module": module.name, "at": module.started}
        if module.name != "pc" and module.name in MODULES:
            self._news(started)
        env = self._environment(module.name)
        for name, argv in self._programs(module):
            watched = name == "node of pc"
            child = await Child.start(name, argv, env, self._hearing(module), piped=watched)
            module.children.append(child)
            if watched:
                self._tell_early_news(child)
                self._news(started)
            self._follow(self._watch(module, child), f"watch {name}")

    def _programs(self, module: Module) -> list[tuple[str, list[str]]]:
        options = [
            *("--core-port", str(module.core_port), "--interface", "lo", "--multicast", self._group(module.name)),
            *("--config", str(self._home.settings)),
        ]
        rmpa, file = rmpa_program(), str(HERE / f"{module.name}.py")
        if module.name in JOINING:
            own = ["--name", module.name, *gateway_options(module.name, self._router_port)]
            return [(module.name, [rmpa, "gateway", *own, *options, "--log-level", "error"])]
        if module.name == "pc":
            node = [sys.executable, file, "--master", f"http://127.0.0.1:{module.core_port}/", "--events"]
            node += ["--sites"] if self._sites else []
            return [
                ("agent of pc", [rmpa, "up", "--name", "pc", *options, "--log-level", "error"]),
                ("node of pc", node + (["--json"] if self._as_json else [])),
            ]
        # Agents report lost peers to their log; the table shows those. What a resource says is for the user.
        run = [rmpa, "run", file, "--name", module.name, "--log-level", "warning"]
        if module.name == "joystick" and self._joystick:
            run += ["--set", f"device={self._joystick}"]
        return [(f"module {module.name}", [*run, "--", *options, "--log-level", "error"])]

    def _group(self, name: str) -> str:
        """Where the beacons of a module go: one port, or one for each site."""
        site = site_of(name) if self._sites else ""
        if self._sites and not site:
            return "off"
        if site not in self._groups:
            self._groups[site] = f"{GROUP}:{free_port(socket.SOCK_DGRAM, self._taken)}"
        return self._groups[site]

    def _follow(self, work: Coroutine[object, object, None], name: str) -> None:
        task = asyncio.create_task(work, name=name)
        self._watching.add(task)
        task.add_done_callback(self._watching.discard)

    def _environment(self, agent: str) -> Mapping[str, str]:
        foreign = ("ROS_", "RMPA_", "NOTIFY_SOCKET")
        kept = {name: value for name, value in os.environ.items() if not name.startswith(foreign)}
        return {**kept, **self._home.variables, "RMPA_AGENT": agent}

    def _hearing(self, module: Module) -> Callable[[str], None]:
        if module.name == "pc":
            return lambda _: None
        return lambda text: self._news({"event": "note", "module": module.name, "text": text})

    async def _watch(self, module: Module, child: Child) -> None:
        status = await child.ended()
        if child.ours or self._over.is_set():
            return
        young = time.monotonic() - module.started < STARTING
        if young and any("in use" in line for line in child.tail) and module.starts < STARTS_MAX:
            await self._kill(module)
            module.core_port = free_port(socket.SOCK_STREAM, self._taken)
            await self._start(module)
            return
        self._failed(child, status, module.name)
        if child.process.stdin is not None:
            self._over.set()  # without the pc's node nothing is shown

    def _failed(self, child: Child, status: int | None, module: str) -> None:
        tail = "\n".join(f"    {line}" for line in child.tail)
        self.failures.append(f"the {child.name} ended with status {status}\n{tail}")
        self._news({"event": "note", "module": module, "text": f"the {child.name} ended with status {status}"})

    async def _kill(self, module: Module) -> None:
        await asyncio.gather(*(child.kill() for child in module.children))

    def _news(self, news: dict[str, object]) -> None:
        """Tell the pc's node; what happens before its first start waits for it."""
        line = json.dumps(news).encode() + b"\n"
        if self._untold is not None:
            self._untold.append(line)
        for child in self._modules["pc"].children:
            child.tell(line)

    def _tell_early_news(self, child: Child) -> None:
        early, self._untold = self._untold, None
        for line in early or ():
            child.tell(line)

    # --- commands from a second terminal ------------------------------------------------------------------------

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            request = json.loads(await reader.readline())
            text, ok = await self._do(str(request["do"]), str(request["module"])), True
        except Refused as refusal:
            text, ok = str(refusal), False
        except (ValueError, TypeError, KeyError):
            text, ok = "not a command", False
        with contextlib.suppress(OSError):
            writer.write(json.dumps({"ok": ok, "text": text}).encode() + b"\n")
            await writer.drain()
        writer.close()

    async def _do(self, verb: str, name: str) -> str:
        module = self._modules.get(name)
        if module is None:
            raise Refused(f"no module named {name!r}: there are {', '.join(self._modules)}")
        if verb == "kill":
            if not module.runs:
                raise Refused(f"{name} does not run; `demo.py start {name}` starts it")
            at = time.monotonic()
            pids = ", ".join(str(pid) for child in module.children if child.runs for pid in child.pids())
            # Told first: on a busy machine the pc's agent may see it gone before we have buried it.
            if name in MODULES:
                self._news({"event": "killed", "module": name, "at": at})
            await self._kill(module)
            if name == "pc":
                print("the pc is killed, the others go on; start it: make demo-start MODULE=pc", file=sys.stderr)
            what = "its agent and its node" if name in MODULES else "its process"
            return f"{name} is killed (kill -9 of {what}, processes {pids})"
        if verb == "start":
            if module.runs:
                raise Refused(f"{name} runs already")
            module.starts = 0
            await self._start(module)
            return f"{name} is started"
        raise Refused(f"no command {verb!r}: there are kill and start")

    # --- the end ------------------------------------------------------------------------------------------------

    def _children(self) -> list[Child]:
        page = [self._page.child] if self._page.child is not None else []
        modules = [child for module in self._modules.values() for child in module.children]
        return [child for child in (*modules, *page) if child.runs]

    async def _end(self) -> None:
        self._over.set()
        if self._server is not None:
            self._server.close()
        # The pc's node first: it prints the summary, of all four. The page leaves the pc's core while that is there.
        first = [*self._modules["pc"].children[1:], *([self._page.child] if self._page.child else [])]
        for child in first:
            child.send(signal.SIGTERM)
        await asyncio.gather(*(child.ended(FAREWELL) for child in first))
        children = self._children()
        for child in children:
            child.send(signal.SIGTERM)
        await asyncio.gather(*(child.ended(FAREWELL) for child in children))
        for child in self._children():
            self.failures.append(f"the {child.name} did not end within {FAREWELL} s, and was killed")
            await child.kill()
        await asyncio.gather(*self._watching, *self._killing, return_exceptions=True)


def rmpa_program() -> str:
    """The path of ``rmpa``.

    Raises:
        Refused: It is not installed.
    """
    beside = Path(sys.executable).with_name("rmpa")
    found = str(beside) if beside.exists() else shutil.which("rmpa")
    if not found:
        raise Refused("the program rmpa is not installed for this Python; `make` builds .venv with it")
    return found
