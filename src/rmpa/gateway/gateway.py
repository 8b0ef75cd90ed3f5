"""The process of ``rmpa gateway``: an agent that relays, one Zenoh session, and the neighbours that it joins."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import random
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from rmpa.agent.agent import Agent
from rmpa.agent.process import run_process, serve
from rmpa.config.settings import ResourceSettings, Settings
from rmpa.core.errors import RmpaError, StartError
from rmpa.core.timers import Backoff
from rmpa.gateway import limits
from rmpa.gateway.own_graph import AgentGraph
from rmpa.gateway.zenoh.session import OpenSession, open_trusted_session
from rmpa.observe.control_client import GATEWAY_REPORT, GATEWAY_ROLE, ROLE
from rmpa.runtime.plugins import NEIGHBOURS, load_plugins, plugin_error
from rmpa.runtime.tasks import keep_task, start_task

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterator, Mapping

    from rmpa.config.read import Loaded
    from rmpa.gateway.ros2.graph import Ros2Link
    from rmpa.gateway.ros2.rclpy_session import RclpySession
    from rmpa.gateway.rules import Neighbour

_log = logging.getLogger(__name__)

# Seconds until a gateway without keys looks again whether an agent of a secured mesh runs beside it.
_AGENTS_LOOK_PERIOD: Final = 5.0
# The longest time in seconds between two attempts to open a session.
_OPEN_RETRY_MAX: Final = 5.0


class Gateway:
    """A gateway: its agent, its session and its neighbours; one task keeps the session and makes both anew.

    Args:
        settings: Complete: the name is filled in.
        realtime: The outcomes of ``--realtime``, ready to read.
        load: Reads the settings again; it may block.
        open_session: Opens the session; raises ``StartError``.
        make_neighbours: ``(graph, session, settings)``: makes the neighbours by their names; they are not started.

    Attributes:
        session: The session; ``None`` until it is open. Where ROS 2 alone is joined by rclpy it is that one.
        ros2: The session of rclpy; ``None`` without.
        neighbours: The neighbours by their names; empty until the session is open.
    """

    def __init__(
        self,
        settings: Settings,
        realtime: tuple[str, ...] = (),
        load: Callable[[], Loaded] | None = None,
        *,
        open_session: Callable[[Settings], Coroutine[None, None, OpenSession]] = open_trusted_session,
        make_neighbours: Callable[[AgentGraph, Any, Settings], Mapping[str, Neighbour]] | None = None,
    ) -> None:
        self._settings = _own(settings)
        self._open_session = open_session
        self._make_neighbours = make_neighbours or self._make
        self.agent = Agent(self._settings, realtime, load)
        self.graph = AgentGraph(self.agent, self._settings)
        self.agent.bridge.add(self.graph)
        self.agent.control.add({GATEWAY_REPORT: lambda _: self.report(), ROLE: lambda _: GATEWAY_ROLE})
        self.agent.other_notes.append(self._notes)
        self.graph.reloaded = self._reloaded
        if self.agent.trust is not None:
            self.agent.trust.membership.on_denied.append(self._denied)
        self.session: Ros2Link | None = None
        self.ros2: RclpySession | None = None
        self.neighbours: dict[str, Neighbour] = {}
        self._problem = ""
        # Set where the neighbours have to be made anew.
        self._changed = asyncio.Event()
        # Whether the session has to be opened anew with them.
        self._reopen = False
        self._leaving = asyncio.Lock()
        self._running: asyncio.Task[None] | None = None

    async def start(self) -> None:
        """Start the agent and the neighbours; where only ``connect`` is set, a router may come later.

        Raises:
            StartError: The agent or the session cannot start on this machine with these settings.
        """
        # At once: the library is read in another thread while the agent starts.
        opening = start_task(self._open(), "open the session", raises=(StartError,))
        try:
            await self.agent.start()
        except BaseException:
            await _discard(opening)
            raise
        try:
            await self.graph.begin()
            try:
                self._join(await opening)
            except StartError as error:
                if self._settings.gateway.listen or not self._settings.gateway.connect:
                    raise
                self._failed(error)
        except BaseException:
            await _discard(opening)
            await self.close()
            raise
        self._running = keep_task(self._run, "keep the zenoh session")

    async def close(self) -> None:
        """Take everything back: the neighbours first, the agent last."""
        if self._running is not None:
            async with self._leaving:  # what is being closed is closed to the end
                self._running.cancel()
            await asyncio.wait([self._running])
        await self._close_neighbours()
        for session in dict.fromkeys((self.session, self.ros2)):
            if session is not None:
                await session.close()
        await self.graph.end()
        await self.agent.close()

    async def _open(self) -> Ros2Link:
        gateway = self._settings.gateway
        if gateway.via_rclpy and self.ros2 is None:
            from rmpa.gateway.ros2.ros2 import open_rclpy_session  # noqa: PLC0415 - not every gateway needs it

            self.ros2 = await open_rclpy_session(self._settings)
        if self.ros2 is not None and not (gateway.site or gateway.router):
            return self.ros2
        return await self._open_session(self._settings)

    async def _close_neighbours(self) -> None:
        for name, neighbour in reversed(list(self.neighbours.items())):
            try:
                await neighbour.close()
            except Exception:  # noqa: BLE001 - the others have to be closed too
                _log.exception("! %s could not be closed", name)
        self.neighbours = {}

    def _reloaded(self, settings: Settings) -> None:
        """Have other rules hold: the neighbours are made anew, and what crosses pauses for a moment."""
        before, self._settings = self._settings, _own(settings)
        if settings.gateway.listen and before.trust != settings.trust:
            self._reopen = True  # Zenoh reads its table of access once
        if self._reopen or _rules(before) != _rules(settings):
            self._changed.set()

    def _denied(self) -> None:
        """Have the router refuse what was revoked: its session is opened again with another table of access."""
        if self._settings.gateway.listen:
            self._reopen = True
            self._changed.set()

    async def _run(self) -> None:
        """Open the session until it is open; make neighbours and session anew where other rules hold."""
        backoff = Backoff(limits.OPEN_RETRY_FIRST, _OPEN_RETRY_MAX, random.random)
        while True:
            if self.session is None:
                await asyncio.sleep(backoff.delay())
                self._reopen = False  # what it was asked for is read now
                self._changed.clear()
                try:
                    self._try_to_join(await self._open())
                    backoff.reset()
                except StartError as error:
                    self._failed(error)
                continue
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(limits.CERTIFICATE_LOOK_PERIOD):
                    await self._changed.wait()
            self._count()
            if self.session.stale:  # its certificate was renewed, which Zenoh reads once
                self._reopen = True
            if self._reopen or self._changed.is_set():
                async with self._leaving:
                    await self._leave(self.session)

    async def _leave(self, session: Ros2Link) -> None:
        self._changed.clear()
        await self._close_neighbours()
        self.graph.unwatch()
        if not self._reopen:
            self._try_to_join(session)
            return
        self.session = None
        await session.close()
        _log.info("= the zenoh session is opened again: certificate, permissions or deny list have changed")

    def _count(self) -> None:
        """Add what the session has refused to the agent's counters, which `rmpa doctor` and /diagnostics show."""
        refused = self.session.take_refused() if self.session is not None else {}
        for reason, count in refused.items():
            self.agent.bridge.counters.add(reason, count)

    def report(self) -> dict[str, object]:
        """What the gateway joins, as JSON values: the reply to the operation ``gateway``."""
        self._count()
        session = self.session
        return {
            "name": self._settings.name,
            "site": self._settings.gateway.site,
            "zid": session.zid if session is not None else "",
            "problem": self._problem,
            "stale": session.stale if session is not None else False,
            "neighbours": {name: neighbour.report() for name, neighbour in self.neighbours.items()},
        }

    def _notes(self) -> Iterator[str]:
        if self.ros2 is not None and self.ros2.problem:
            yield f"gateway: {self.ros2.problem}"
        if self._problem:
            yield f"gateway: {self._problem}"
        elif self.session is not None and self._settings.gateway.connect and not self.session.endpoints:
            yield f"gateway: no router is connected; it is to be at {', '.join(self._settings.gateway.connect)}"

    def _join(self, session: Ros2Link) -> None:
        self.session = session
        self._problem = ""
        self.neighbours = dict(self._make_neighbours(self.graph, session, self._settings))
        for neighbour in self.neighbours.values():
            neighbour.start()
        self._join_others(session)
        way = "rclpy" if session is self.ros2 else "zenoh"
        _log.info("= joined: %s; %s session %s", ", ".join(self.neighbours) or "none", way, session.zid)

    def _make(self, graph: AgentGraph, session: Any, settings: Settings) -> dict[str, Neighbour]:
        """Make the neighbours that the settings ask for, by their names; they are not started.

        Raises:
            ConfigError: A setting of one is wrong.
        """
        neighbours: dict[str, Neighbour] = {}
        if settings.gateway.site:
            from rmpa.gateway.sites.answers import make_site_neighbour  # noqa: PLC0415 - not every gateway needs it

            neighbours["sites"] = make_site_neighbour(graph, session, settings)
        if settings.gateway.ros2.enabled:
            from rmpa.gateway.ros2.ros2 import make_ros2_neighbour  # noqa: PLC0415 - it reads all types of ROS

            neighbours["ros2"] = make_ros2_neighbour(graph, self.ros2 or session, settings)
        return neighbours

    def _join_others(self, session: Ros2Link) -> None:
        """Make and start the neighbours of other packages; one that fails is logged, and left out."""
        for entry, make in load_plugins(NEIGHBOURS):
            try:
                neighbour = make(self.graph, session, self._settings)
                if neighbour is not None:
                    neighbour.start()
                    self.neighbours[entry.name] = neighbour
            except Exception as error:  # noqa: BLE001 - another's code
                _log.warning("! %s [plugin-broken]", plugin_error(entry, error))

    def _failed(self, error: StartError) -> None:
        if str(error) != self._problem:
            self._problem = str(error)
            _log.warning("! %s; it is tried again [zenoh-trouble]", error)

    def _try_to_join(self, session: Ros2Link) -> None:
        """Makes the neighbours while the gateway runs: what is wrong with them is told, and ends nothing else."""
        try:
            self._join(session)
        except RmpaError as error:
            self._problem = str(error)
            _log.error("! %s [%s]", error, error.code)
        except BaseException:
            self._changed.set()  # they are made anew when ``_run`` goes on
            raise


def _own(settings: Settings) -> Settings:
    """The settings of a gateway's agent: it relays; resources are started by the module's own."""
    return replace(settings, relay=True, resources=ResourceSettings())


def _rules(settings: Settings) -> tuple[object, ...]:
    """The settings that neighbours are made with and that may change while they run."""
    trust, policy = settings.trust, (settings.policy, settings.peers, settings.services)
    return settings.gateway.rules, policy, settings.contracts, (trust.default, trust.groups, trust.rules)


async def _discard(opening: asyncio.Future[Ros2Link]) -> None:
    """Closes a session that is not needed any more, once it is open."""
    with contextlib.suppress(StartError):
        await (await opening).close()


async def _main(
    settings: Settings,
    realtime: tuple[str, ...],
    load: Callable[[], Loaded] | None,
    check: Callable[[], None],
) -> None:
    gateway = Gateway(settings, realtime, load)
    await serve(gateway.start, gateway.close, gateway.agent.reloader, lambda: _keep_checking(check))


async def _keep_checking(check: Callable[[], None]) -> None:
    """Check again and again whether this gateway may run: an agent may start after it.

    Raises:
        StartError: It may not.
    """
    while True:
        await asyncio.sleep(_AGENTS_LOOK_PERIOD)
        try:
            await asyncio.to_thread(check)
        except StartError:
            raise
        except RmpaError as error:  # an agent that ends just now, or hangs
            _log.debug("! %s", error)


def run(
    settings: Settings, load: Callable[[], Loaded] | None = None, check: Callable[[], None] = lambda: None
) -> int:
    """Run a gateway until SIGINT or SIGTERM; return the exit code.

    Args:
        settings: Complete: the name is filled in.
        load: Reads the settings again, at SIGHUP and ``rmpa reload``.
        check: Raises ``StartError`` where it may not run, or not any more; called in a thread.

    Raises:
        StartError: The gateway cannot start on this machine with these settings, or ``check`` has ended it.
    """
    return run_process(settings, lambda realtime: _main(settings, realtime, load, check))
