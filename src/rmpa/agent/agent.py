"""Builds the rooms of an agent, wires them, and closes them in order."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import random
import socket
import time
from typing import TYPE_CHECKING, Final

from rmpa.agent.core_choice import make_core, start_core
from rmpa.agent.network import Network
from rmpa.agent.permission_notes import permission_notes
from rmpa.agent.process import run_process, serve
from rmpa.agent.reload import Reloader
from rmpa.agent.trust import AgentTrust, open_membership
from rmpa.agent.trust_operations import PlainOperations, TrustOperations
from rmpa.agent.web_process import WebProcess, web_command, web_environment
from rmpa.bridge.bridge import Bridge, TwinWatch
from rmpa.bridge.nodes import NodePresence, NodeRequests
from rmpa.bridge.params.follower import Params
from rmpa.bridge.policy import Needs, Policy
from rmpa.bridge.proxies import Names
from rmpa.bridge.services.exports import ServiceRules
from rmpa.bridge.services.part import Services
from rmpa.core.counters import Counters
from rmpa.discovery.network import list_interfaces
from rmpa.observe.io.control_operations import ControlOperations
from rmpa.observe.io.control_server import ControlServer
from rmpa.observe.io.diagnostics import Diagnostics
from rmpa.observe.io.graph_revision import GraphRevisions
from rmpa.observe.io.peer_clocks import PeerClocks
from rmpa.observe.io.peer_credentials import control_access
from rmpa.observe.io.runtime_dir import runtime_dir
from rmpa.observe.io.site_requests import SiteRequests
from rmpa.observe.io.snapshot_builder import SnapshotBuilder, SnapshotSources
from rmpa.observe.peer_agent import INFO
from rmpa.observe.why.io.why import WhyService
from rmpa.ros.node.slave_node import LoggerServices
from rmpa.runtime import process as garbage_collector
from rmpa.runtime.loop import SystemClock
from rmpa.runtime.tcp_connections import may_end_connections
from rmpa.trust.certificates import host_names, page_hosts
from rmpa.trust.documents import Permissions

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from rmpa.config.read import Loaded
    from rmpa.config.settings import Settings
    from rmpa.core.identity import Identity
    from rmpa.observe.io.control_server import Handler
    from rmpa.ros.core.api import Core

_log = logging.getLogger(__name__)

_LOGGERS: Final = {
    name: name for name in ("rmpa", "rmpa.agent", "rmpa.bridge", "rmpa.discovery", "rmpa.mesh", "rmpa.ros")
}
"""The loggers that /rmpa/set_logger_level can set: the whole agent, or one room."""


class Agent:
    """One module's agent: core, bridge and network, and the interfaces by which it is observed.

    Args:
        settings: Complete: the name is filled in.
        realtime: The outcomes of ``--realtime``, ready to read.
        load: Reads the settings again, as they were read for this agent; it may block.
    """

    def __init__(
        self,
        settings: Settings,
        realtime: tuple[str, ...] = (),
        load: Callable[[], Loaded] | None = None,
    ) -> None:
        self._settings = settings
        clock = SystemClock()
        membership = open_membership(settings, clock)
        policy, names = Policy(settings.policy, settings.peers, settings.time), Names(settings.naming)
        self.core: Core = make_core(settings)
        self.bridge = Bridge(
            self.core,
            policy,
            rng=random.random,
            contracts=settings.make_contracts(),
            names=names,
            relay=settings.relay,
            limit_settings=settings.limits,
            permissions=Permissions(settings.trust) if membership is not None else None,
        )
        self.params = Params(
            self.core,
            self.bridge.node,
            self.bridge.rpc,
            self.bridge.sessions.linked,
            self.bridge.counters,
            settings.params,
            settings.time,
            settings.limits.params,
            self.bridge.gate,
        )
        rules = ServiceRules(settings.services, policy, names)
        self.services = Services(
            self.core,
            self.bridge.sessions,
            self.bridge.rpc,
            self.bridge.relay,
            rules,
            settings.limits,
            self.bridge.counters,
            self.bridge.gate,
        )
        self._nodes = NodeRequests(settings, self.core, self.bridge.rpc, self.bridge.gate)
        presence = NodePresence(
            self.core,
            self.bridge.sessions,
            self.bridge.rpc,
            self.bridge.topics,
            self.services,
            settings,
            self._nodes.visible,
        )
        twins = TwinWatch(self.core, self.bridge, settings.peers)
        for part in (self.params, self.services, presence, twins):
            self.bridge.add(part)
        self.trust: AgentTrust | None = None
        """This module's part in a secured mesh; ``None``: trust is off."""
        if membership is not None:
            self.trust = AgentTrust(membership, self.bridge, clock, random.random, self._page_hosts)
            self.bridge.add(self.trust)
        self.network = Network(settings, self.bridge, self.trust)
        self.reloader = Reloader(settings, load, self.apply_settings)
        self.reloaded: Callable[[], None] = lambda: None
        """Called when changed settings hold."""
        self.other_notes: list[Callable[[], Iterable[str]]] = []
        """What else the snapshot's notes tell: of parts that the agent does not make itself."""
        counters = Counters()
        # Memory that is locked stays; and what is returned would have to be read in again in the midst of data.
        self._clocks = PeerClocks(self.bridge)
        sources = SnapshotSources(
            core=self.core,
            bridge=self.bridge,
            clocks=self._clocks,
            services=self.services,
            twins=twins,
            endpoint=lambda: self.network.endpoint,
            counters=(counters,),
            notes=self._notes,
            started=time.time(),
            realtime=realtime,
            trust=self.trust.status if self.trust is not None else lambda: None,
        )
        self.snapshots = SnapshotBuilder(settings, sources)
        needs = Needs((), "figures of the agent, none of the module's graph")
        self.bridge.rpc.on_request(INFO, lambda _asker, _args: self.snapshots.peer_agent(), needs)
        self.sites = SiteRequests(self.bridge.rpc, self.bridge.sessions.linked, self.bridge.gate)
        """Answers questions about other sites; a gateway answers them itself."""
        self.why = WhyService(settings, self.core, self.bridge, self.services, self.snapshots, self.sites)
        self.operations = ControlOperations(
            settings.name, self.bridge, self.params, self.snapshots, self._nodes, self.sites
        )
        self.trust_commands = self._trust_operations()
        handlers: dict[str, Handler] = {
            **self.operations.handlers(),
            "why": self.why.answer,
            "reload": lambda args: self.reloader.reload(check=args.get("check") is True),
            "graph": GraphRevisions(self.core, rows=settings.core_mode == "embedded").after,
            "trust": self.trust_commands.answer_command,
        }
        self._control = ControlServer(
            runtime_dir(os.environ, settings.runtime_dir),
            settings.name,
            handlers,
            counters=counters,
            access=control_access(settings.control_group),
        )

    def add_operations(self, handlers: Mapping[str, Handler]) -> None:
        """Add operations to the control socket, before ``start()``."""
        self._control.add(handlers)

    async def start(self) -> None:
        """Start every part; the network comes last, so that peers find a complete agent.

        Raises:
            StartError: The name, the core's port or the mesh's port is taken.
        """
        for note in permission_notes(self._settings, secured=self.bridge.gate.on):
            _log.warning("! %s", note)
        self._warn_of_stale_connections()
        async with contextlib.AsyncExitStack() as undo:
            self._control.lock()
            undo.push_async_callback(self._control.close)
            await start_core(self.core, self._settings)
            undo.push_async_callback(self.core.close)
            await self.bridge.start()
            undo.push_async_callback(self.bridge.close)
            diagnostics = Diagnostics(self.core, self.bridge, self.snapshots, self._clocks)
            diagnostics.start()
            undo.callback(diagnostics.close)
            loggers = LoggerServices(self.bridge.node, self.core.call, _LOGGERS)
            loggers.start()
            undo.callback(loggers.close)
            await self.network.start()
            undo.push_async_callback(self.network.close)
            await self._control.start()
            garbage_collector.take_over()
            undo.callback(garbage_collector.give_back)
            self._undo = undo.pop_all()
        _log.info("= ROS_MASTER_URI=%s", self.core.uri)

    def _trust_operations(self) -> PlainOperations | TrustOperations:
        if self.trust is None:
            return PlainOperations(self._settings)
        return TrustOperations(self.trust, self.bridge, self._identity)

    def _page_hosts(self) -> tuple[str, ...]:
        """The names and addresses by which this module's page is opened; a gateway has none."""
        if self._settings.relay:
            return ()
        addresses = [str(address) for interface in list_interfaces() for address in interface.addresses]
        return page_hosts((*host_names(socket.gethostname()), *self._settings.web.hosts, *sorted(addresses)))

    def _identity(self) -> Identity | None:
        return self.network.endpoint.identity if self.network.endpoint is not None else None

    async def close(self) -> None:
        """Close every part: the goodbye comes first, then the proxies leave the local graph, the core is last."""
        await self._undo.aclose()

    def _notes(self) -> Iterator[str]:
        yield from (f"{key} waits for a restart" for key in self.reloader.waiting)
        yield from self.params.notes()
        yield from permission_notes(self._settings, secured=self.bridge.gate.on)
        if self.trust is not None:
            yield from self.trust.notes()
        for notes in self.other_notes:
            yield from notes()

    def _warn_of_stale_connections(self) -> None:
        """Say beforehand what happens when the host of a direct subscriber vanishes, if the agent may not end it."""
        if self._settings.allows_direct and (problem := may_end_connections()):
            reason, _, remedy = problem.partition("; ")
            effect = "when that of a direct subscriber does, a rospy publisher without queue_size may hang"
            text = f"the agent may not end connections that a vanished host leaves behind ({reason}): {effect}"
            _log.warning("! %s; %s (docs/systemd.md)", text, remedy)

    def apply_settings(self, settings: Settings) -> None:
        """Take settings that were read again; only those of ``agent.reload.LIVE`` differ."""
        before, self._settings = self._settings, settings
        if not before.allows_direct:
            self._warn_of_stale_connections()
        logging.getLogger().setLevel(settings.log_level.upper())
        for part in (self.bridge, self.snapshots, self.why, self._nodes):
            part.reload(settings)
        self.reloaded()


async def _serve(
    settings: Settings,
    realtime: tuple[str, ...],
    load: Callable[[], Loaded] | None = None,
    started: Callable[[], None] = lambda: None,
) -> None:
    agent = Agent(settings, realtime, load)
    web = WebProcess(web_command(settings), random.random, environ=web_environment(settings, os.environ))
    agent.reloaded = web.reload

    async def start() -> None:
        await agent.start()
        await asyncio.to_thread(started)
        if settings.web.enabled:
            web.start()

    async def close() -> None:
        await web.close()
        await agent.close()

    await serve(start, close, agent.reloader)


def run(
    settings: Settings, load: Callable[[], Loaded] | None = None, started: Callable[[], None] = lambda: None
) -> int:
    """Run an agent until SIGINT or SIGTERM; return the exit code.

    Args:
        settings: Complete: the name is filled in.
        load: Reads the settings again, at SIGHUP and ``rmpa reload``.
        started: Called in a thread once the agent has started.

    Raises:
        StartError: The agent cannot start on this machine with these settings.
    """
    return run_process(settings, lambda realtime: _serve(settings, realtime, load, started))
