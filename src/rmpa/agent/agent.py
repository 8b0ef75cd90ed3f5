"""Builds the rooms of one agent, wires them, and ends them in order."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import random
import signal
import sys
import time
from typing import TYPE_CHECKING, Final

from rmpa.agent.core_choice import make_core
from rmpa.agent.node_requests import NodeRequests
from rmpa.agent.param_requests import ParamOps
from rmpa.agent.reload import Hangups, Reloader
from rmpa.bridge.io.bounds import Bounds
from rmpa.bridge.io.bridge import Bridge
from rmpa.bridge.io.network_endpoint import NetworkEndpoint
from rmpa.bridge.naming import Names
from rmpa.bridge.params.io.part import Params
from rmpa.bridge.policy import Policy
from rmpa.bridge.services.io.part import Services
from rmpa.bridge.services.rules import ServiceRules
from rmpa.config.values import did_you_mean
from rmpa.core.contract import Contracts
from rmpa.core.counters import Counters
from rmpa.core.errors import ConfigError, PeerRefused, RmpaError, StartError, UnreachableError
from rmpa.core.open_files import remedy
from rmpa.mesh import limits as mesh_limits
from rmpa.observe import limits as observe_limits
from rmpa.observe.io.control_server import ControlServer
from rmpa.observe.io.diagnostics import Diagnostics
from rmpa.observe.io.peer_clocks import PeerClocks
from rmpa.observe.io.runtime_dir import runtime_dir
from rmpa.observe.io.services_section import ServicesSection
from rmpa.observe.io.snapshot_builder import SnapshotBuilder
from rmpa.observe.io.why import WhyService
from rmpa.observe.snapshot import FollowedInfo, PingReply, Snapshot
from rmpa.ros.node.logger_services import LoggerServices
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime import realtime
from rmpa.runtime.descriptors import is_shortage, raise_file_limit
from rmpa.runtime.event_loop import AgentLoop
from rmpa.runtime.garbage_collector import GarbageCollector
from rmpa.runtime.service_manager import notify_service_manager

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.config.settings import Settings
    from rmpa.config.sources import Loaded
    from rmpa.mesh.io.link import PeerLink
    from rmpa.observe.reload_reply import ReloadReply
    from rmpa.observe.why.diagnosis import Diagnosis
    from rmpa.ros.core.api import Core

_log = logging.getLogger(__name__)

_LOGGERS: Final = {
    name: name for name in ("rmpa", "rmpa.agent", "rmpa.bridge", "rmpa.discovery", "rmpa.mesh", "rmpa.ros")
}
"""What /rmpa/set_logger_level turns up and down: the whole agent, or one room."""


class Agent:
    """One module's agent: core, discovery, mesh and bridge.

    Args:
        settings: Complete: the name is filled in.
        wishes: What ``realtime.apply`` brought.
        load: Reads the settings again, as they were read for this agent; it may block.
    """

    def __init__(
        self,
        settings: Settings,
        wishes: tuple[realtime.SchedulingRequest, ...] = (),
        load: Callable[[], Loaded] | None = None,
    ) -> None:
        self._settings = settings
        self._control = ControlServer(
            runtime_dir(os.environ, settings.runtime_dir),
            settings.name,
            {
                "snapshot": self._snapshot,
                "ping": self._ping,
                "why": self._why,
                "reload": self._reload,
                "param": self._param,
                "followed": self._followed,
                "node": self._node,
            },
        )
        self.core: Core = make_core(settings)
        self.bridge = Bridge(
            self.core,
            Policy(settings.policy, settings.peers, settings.time),
            rng=random.random,
            contracts=Contracts(settings.contracts),
            names=Names(settings.peers),
            relay=settings.relay,
            most=settings.limits,
        )
        self.station: NetworkEndpoint | None = None
        self._moving: asyncio.Task[None] | None = None
        counters = Counters()
        self._collector = GarbageCollector(self._carried, counters)
        self._clocks = PeerClocks(self.bridge)
        self._view = SnapshotBuilder(
            settings,
            self.core,
            self.bridge,
            self._clocks,
            self._control.counters,
            counters,
            started=time.time(),
            wishes=wishes,
        )
        self.params = Params(
            self.core,
            self.bridge.node,
            self.bridge.asks,
            self.bridge.sessions.linked,
            self.bridge.counters,
            settings.params,
            settings.time,
            settings.limits.params,
        )
        self.bridge.add(self.params)
        rules = ServiceRules(
            settings.services, Policy(settings.policy, settings.peers, settings.time), Names(settings.peers)
        )
        self.services = Services(
            self.core,
            self.bridge.sessions,
            self.bridge.asks,
            self.bridge.relay,
            rules,
            settings.limits,
            self.bridge.counters,
        )
        self.bridge.add(self.services)
        bounds = Bounds(self.bridge.sessions, self.bridge.asks, self.bridge.topics, self.services, settings.limits)
        self.bridge.add(bounds)
        self._view.watch(bounds)
        self._view.services = ServicesSection(self.services)
        self._nodes = NodeRequests(settings, self.core, self.bridge, self._attached)
        self._param_ops = ParamOps(self.params, self.bridge.asks, self._attached)
        self.reloader = Reloader(settings, load, self._take)
        self._view.parameters = self.params.notes
        self._view.waiting = lambda: self.reloader.waiting
        self._whys = WhyService(settings, self.core, self.bridge, self.services, self._view)

    async def start(self) -> None:
        """Start every part; the network last, so that who finds us finds us ready.

        Raises:
            StartError: The name, the core's port or the mesh's port is taken.
        """
        async with contextlib.AsyncExitStack() as undo:
            self._control.lock()
            undo.push_async_callback(self._control.close)
            await self.core.start()
            undo.push_async_callback(self.core.close)
            await self.bridge.start()
            undo.push_async_callback(self.bridge.close)
            diagnostics = Diagnostics(self.core, self.bridge, self._view, self._clocks)
            diagnostics.start()
            undo.callback(diagnostics.close)
            loggers = LoggerServices(self.bridge.node, self.core.call, _LOGGERS)
            loggers.start()
            undo.callback(loggers.close)
            await self._join(self._settings.port)
            undo.push_async_callback(self._leave)
            await self._control.start()
            self._collector.start()
            undo.callback(self._collector.close)
            self._undo = undo.pop_all()
        _log.info("= ROS_MASTER_URI=%s", self.core.uri)

    async def close(self) -> None:
        """End every part: goodbye first, then the local graph's foreign nodes, the core last."""
        if self._moving is not None:
            self._moving.cancel()
        await self._undo.aclose()

    # --- the place in the network ------------------------------------------------------------------------------

    async def _join(self, port: int) -> None:
        self.station = NetworkEndpoint(self._settings, self.bridge, port=port, on_displaced=self._displaced)
        self._view.station = self.station
        await self.station.start()

    async def _leave(self) -> None:
        if self.station is not None:
            station, self.station = self.station, None
            self._view.station = None
            await station.close()

    def _carried(self) -> int:
        links = (attached.link for attached in self.bridge.attached())
        return sum(link.bytes_in + link.bytes_out for link in links)

    def _displaced(self) -> None:
        if self._moving is None:
            self._moving = asyncio.create_task(self._move(), name="move to the new address")

    async def _move(self) -> None:
        try:
            port = self.station.port if self.station is not None else self._settings.port
            _log.info("= the machine's addresses have changed: taking a new GUID")
            await self._leave()
            while self.station is None:
                try:
                    await self._join(port)
                except RmpaError as error:
                    _log.warning("! cannot join with the new address yet: %s", error)
                    await asyncio.sleep(mesh_limits.JOIN_RETRY)
        finally:
            self._moving = None

    def _take(self, settings: Settings) -> None:
        """Let other settings hold; only what ``agent.reload`` calls live differs."""
        self._settings = settings
        logging.getLogger().setLevel(settings.log_level.upper())
        self.bridge.reload(settings)
        self._view.reload(settings)
        self._whys.reload(settings)
        self._nodes.reload(settings)

    # --- the control socket's handlers -------------------------------------------------------------------------

    def _snapshot(self, args: dict[str, object]) -> Snapshot:
        topics = args.get("topics")
        if topics is not None and not isinstance(topics, list):
            raise ConfigError("topics", f"{topics!r} is not a list of topics")
        return self._view.snapshot(frozenset(map(str, topics)) if topics is not None else None)

    async def _ping(self, args: dict[str, object]) -> PingReply:
        link = self._link(str(args.get("peer", "")))
        count = args.get("count", 1)
        if not isinstance(count, int) or not 1 <= count <= observe_limits.CONTROL_PINGS_MAX:
            raise ConfigError("count", f"{count!r} is not between 1 and {observe_limits.CONTROL_PINGS_MAX}")
        times = [await link.ping() for _ in range(count)]
        host, port = link.remote_endpoint
        return PingReply(times=tuple(times), remote=f"{host}:{port}")

    async def _reload(self, args: dict[str, object]) -> ReloadReply:
        return await self.reloader.reload(check=args.get("check") is True)

    async def _why(self, args: dict[str, object]) -> tuple[Diagnosis, ...]:
        return await self._whys.answer(args)

    async def _param(self, args: dict[str, object]) -> object:
        return await self._param_ops.ask(args)

    async def _node(self, args: dict[str, object]) -> object:
        return await self._nodes.ask(args)

    def _followed(self, args: dict[str, object]) -> tuple[FollowedInfo, ...]:
        return self._param_ops.followed(args)

    def _link(self, peer: str) -> PeerLink:
        return self._attached(peer).link

    def _attached(self, peer: str) -> PeerSession:
        linked = {attached.link: attached for attached in self.bridge.attached()}
        links = list(linked)
        fitting = [link for link in links if peer in {link.name, str(link.guid), str(link.guid).partition("#")[0]}]
        if len(fitting) == 1:
            return linked[fitting[0]]
        if fitting:
            raise PeerRefused(self._settings.name, f"{len(fitting)} peers are named {peer}", "name one by its GUID")
        near = did_you_mean(peer, [link.name for link in links])
        remedy = f"did you mean {near}?" if near else "`rmpa peer list` shows who is there, and why one is not linked"
        raise UnreachableError("linked peer", repr(peer), remedy)


async def _serve(
    settings: Settings, wishes: tuple[realtime.SchedulingRequest, ...], load: Callable[[], Loaded] | None = None
) -> None:
    agent = Agent(settings, wishes, load)
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    loop.set_default_executor(realtime.worker_pool())
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    hangups = Hangups(agent.reloader, stop.set)
    await agent.start()
    hangups.start()
    try:
        notify_service_manager("READY=1")
        await stop.wait()
        notify_service_manager("STOPPING=1")
        _log.info("= ending")
    finally:
        await hangups.close()
        await agent.close()


def run(settings: Settings, load: Callable[[], Loaded] | None = None) -> int:
    """Run an agent until SIGINT or SIGTERM; return the exit code.

    Args:
        settings: Complete.
        load: Reads them again, at SIGHUP and `rmpa reload`.

    Raises:
        StartError: It cannot start on this machine as asked.
    """
    raise_file_limit()
    sys.setswitchinterval(runtime_limits.THREAD_SWITCH)
    wishes = realtime.apply(settings.realtime)
    try:
        with asyncio.Runner(loop_factory=AgentLoop) as runner:
            runner.run(_serve(settings, wishes, load))
    except OSError as error:
        if is_shortage(error):
            raise StartError(f"agent {settings.name}", "no file descriptors left", remedy()) from error
        raise
    return 0
