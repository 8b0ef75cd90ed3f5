"""Builds the rooms of an agent, wires them, and closes them in order; and its place in the network.

That place is a GUID and a mesh port, with discovery and mesh, wired to the bridge. When the machine loses the address
in the GUID (an agent that started before the network did has 127.0.0.1), the agent leaves with a goodbye and joins
under a new GUID. It stays the same run, so peers go on where they were. Its core and the local graph do not notice.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import os
import random
from typing import TYPE_CHECKING, Final

from rmpa.agent.process import ChildProcess, Reloader, run_process, serve
from rmpa.agent.trust import AgentTrust, TrustCommands, open_membership, restart_to_join
from rmpa.bridge.bridge import Bridge
from rmpa.bridge.facts import BridgeFacts
from rmpa.bridge.nodes import Nodes
from rmpa.bridge.params.follower import Params
from rmpa.bridge.policy import Needs
from rmpa.bridge.services.part import Services
from rmpa.bridge.subscriptions import Subscriptions
from rmpa.bridge.topics.rates import Rates
from rmpa.bridge.twins import TwinWatch
from rmpa.config.module_name import core_file
from rmpa.core import limits
from rmpa.core.contract import Transport
from rmpa.core.errors import RmpaError, StartError
from rmpa.core.identity import OWN_NODE, Guid, Identity, is_own
from rmpa.core.statistics import Counters
from rmpa.discovery.discovery import Discovery
from rmpa.discovery.network import Interface, choose, further_addresses, list_interfaces, pick_address
from rmpa.mesh.io.link import LinkHandlers, PeerLink
from rmpa.mesh.io.mesh import Mesh
from rmpa.mesh.keepalive import rest_lease
from rmpa.mesh.peering import REPLACED
from rmpa.observe.control_client import ControlClient, find_agents, runtime_dir
from rmpa.observe.control_server import ControlServer, Handler, control_group
from rmpa.observe.graph import GraphRevisions
from rmpa.observe.health import Diagnostics
from rmpa.observe.operations import ControlOperations
from rmpa.observe.sites import SiteRequests
from rmpa.observe.snapshot import INFO, AgentInfo
from rmpa.observe.snapshot_builder import SnapshotBuilder
from rmpa.observe.why.why import WhyService
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.core.external import Core, ExternalCore
from rmpa.ros.environment import DEFAULT_MASTER_URI, RosEnvironment, host_of, is_loopback, shown_uri
from rmpa.ros.http.rpc import call_api, is_own_name
from rmpa.ros.http.server import listen
from rmpa.ros.node.listeners import local_addresses
from rmpa.ros.node.loggers import serve_loggers
from rmpa.runtime.accept import Use, open_mesh_port
from rmpa.runtime.kernel_tcp import may_end_connections
from rmpa.runtime.loop import SystemClock, freeze_heap, thaw_heap
from rmpa.runtime.systemd import unit_of
from rmpa.runtime.tasks import start_task
from rmpa.trust.permissions import Permissions

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from ipaddress import IPv4Address

    from rmpa.config.read import Loaded
    from rmpa.config.settings import Settings
    from rmpa.discovery.membership import PeerEvent

_log = logging.getLogger(__name__)

# Delay before an agent whose addresses have changed tries again to listen at the new address.
JOIN_RETRY: Final = 1.0


class NetworkEndpoint:
    """Discovery and mesh under one identity, feeding the bridge.

    Args:
        network: Has the settings, the bridge, which gets links, and this module's part in a secured mesh.
        port: The mesh port; 0 lets the system choose.

    Raises:
        StartError: The port cannot be bound.
    """

    def __init__(self, network: Network, port: int) -> None:
        settings, bridge, trust, clock = network.settings, network.bridge, network.trust, SystemClock()
        self._network = network
        self._bridge = bridge
        usable = choose(list_interfaces(), settings.interfaces)
        tcp, udp = open_mesh_port(port)
        self.port: int = tcp.getsockname()[1]
        address = pick_address(usable)
        # Seconds modulo 18 hours, so that a restart gets a higher number; the random instance id decides in doubt.
        incarnation = clock.wall_ns() // 1_000_000_000 % (1 << 16)
        self.identity = Identity(
            Guid.of(address, self.port, incarnation),
            network.instance,
            settings.name,
            settings.domain,
            further_addresses(usable, address),
        )
        bridge.place(self.identity)
        self.mesh = Mesh(
            self.identity,
            tcp,
            LinkHandlers(
                self._link_up,
                self._link_down,
                bridge.control,
                bridge.mark,
                bridge.sessions.clock,
                bridge.sessions.lane_lost,
            ),
            lanes=settings.lanes,
            security=trust.membership if trust is not None else None,
            on_join=trust.joins.serve if trust is not None and trust.joins is not None else None,
        )
        self.discovery = Discovery(
            self.identity,
            settings,
            udp,
            on_event=self._event,
            on_interfaces=self._interfaces,
            trust=trust.membership.packets if trust is not None else None,
        )
        self._udp = udp

    async def start(self) -> None:
        """Accept links, then send beacons."""
        await self.mesh.start()
        await self.discovery.start()
        _log.info("= %s, domain %d: peers can find it", self.identity, self.identity.domain)

    async def close(self, *, moves: bool = False) -> None:
        """Send the goodbye, and close the links in order; ``moves``: the agent is back at once, elsewhere."""
        await self.discovery.close()
        self._udp.close()
        await self.mesh.close(moves=moves)

    def _event(self, event: PeerEvent) -> None:
        identity = event.identity
        match event.change:
            case "found":
                _log.info("+ %s found", identity)
                self.mesh.peer_found(identity, event.source[0] if event.source else None)
            case "changed":
                self.mesh.peer_found(identity)
            case "lost":
                _log.info("- %s %s", identity, event.reason)
                self.mesh.peer_gone(identity.guid)
            case "doubted":
                # A link at rest would notice after many seconds that its peer is gone.
                if (link := self.mesh.link(identity.guid)) is not None:
                    link.touch()
            case "conflict":
                pass  # discovery has logged the error, at a bounded rate
        self.mesh.pace.rest_lease = rest_lease(self.discovery.membership.size)

    def _link_up(self, link: PeerLink) -> None:
        # Its beacons come from its mesh port; an accepted connection may come from any port.
        self.discovery.link_up(link.identity, (link.remote_endpoint[0], link.identity.guid.port))
        self._bridge.sessions.link_up(link)

    def _link_down(self, link: PeerLink, reason: str) -> None:
        self._bridge.sessions.link_down(link)
        if reason != REPLACED:  # else its peer stays linked, and keeps its endpoint
            self.discovery.link_down(link.identity.guid, link.identity.instance)

    def _interfaces(self, everything: tuple[Interface, ...]) -> bool:
        """Handle a change of the machine's interfaces; return whether the GUID's address is still valid."""
        displaced = is_displaced(self.identity.guid.address, everything, self._network.settings.interfaces)
        if displaced:
            self._network.move()
        return not displaced


class Network:
    """Keeps an agent in the network, and moves it to a new endpoint when it has lost its address.

    Args:
        settings: The agent's settings.
        bridge: Its bridge.
        trust: This module's part in a secured mesh; ``None``: trust is off.

    Attributes:
        instance: This run, wherever it is in the network.
        endpoint: The place now; ``None`` before the start, and while the agent moves.
    """

    def __init__(self, settings: Settings, bridge: Bridge, trust: AgentTrust | None = None) -> None:
        self.settings = settings
        self.bridge = bridge
        self.trust = trust
        self.instance: Final = os.urandom(limits.INSTANCE_ID_BYTES)
        self._moving: asyncio.Task[None] | None = None
        self._over = asyncio.Event()
        self.endpoint: NetworkEndpoint | None = None

    async def start(self) -> None:
        """Join the network.

        Raises:
            StartError: The mesh's port is taken.
        """
        await self._join(self.settings.port)

    def warn_if_open(self) -> None:
        """Say that trust is off."""
        if self.trust is None and self.endpoint is not None:
            text = (
                "! trust is off: every program that reaches port %d may join; secure it: rmpa trust init [trust-off]"
            )
            _log.warning(text, self.endpoint.port)

    async def close(self) -> None:
        """Leave the network."""
        self._over.set()
        if self._moving is not None:
            await asyncio.wait([self._moving])  # not cancelled: the place that it leaves would stay half closed
        await self._leave()

    async def _join(self, port: int) -> None:
        self.endpoint = NetworkEndpoint(self, port)
        try:
            await self.endpoint.start()
        except BaseException:
            await self._leave()
            raise

    async def _leave(self, *, moves: bool = False) -> None:
        if self.endpoint is not None:
            endpoint, self.endpoint = self.endpoint, None
            await endpoint.close(moves=moves)

    def move(self) -> None:
        """Take a new GUID, with an address that the machine has."""
        if self._moving is None or self._moving.done():
            self._moving = start_task(self._move(), "move to the new address")

    async def _move(self) -> None:
        port = self.endpoint.port if self.endpoint is not None else self.settings.port
        _log.info("= the machine's addresses have changed: taking a new GUID")
        joined = False
        while not joined and not self._over.is_set():
            try:
                await self._leave(moves=True)
                await self._join(port)
                joined = True
            except Exception as error:  # noqa: BLE001 - until it has joined, no change of an address is noticed
                _log.warning("! cannot join the mesh with the new address; tried again: %s [cannot-start]", error)
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._over.wait(), JOIN_RETRY)


def is_displaced(ours: IPv4Address, everything: tuple[Interface, ...], wanted: tuple[str, ...]) -> bool:
    """Whether the agent needs a GUID with another address.

    An interface without its cable keeps its address, and links over other interfaces go on meanwhile. A lost address
    may return (a DHCP lease is renewed), so the GUID stays until the machine has another usable address.

    Args:
        ours: The address in the GUID.
        everything: All interfaces, up or not.
        wanted: The names of the interfaces that the settings give; empty for all.
    """
    if pick_address(choose(everything, wanted)).is_loopback:
        return False
    kept = {address for i in everything if not wanted or i.name in wanted for address in i.addresses}
    return ours.is_loopback or ours not in kept


def permission_notes(settings: Settings, *, secured: bool) -> Iterator[str]:
    """The warnings, each ready to read.

    Args:
        settings: The agent's.
        secured: Whether this module is a member of a secured mesh.
    """
    if not secured and (settings.trust.rules or settings.trust.groups):
        yield (
            "[[permission]] has no effect: this module has not joined a secured mesh, so every peer may do all; "
            "`rmpa trust init` begins one, `rmpa trust join` enters one"
        )
    if secured and not settings.trust.direct and (asked := _asking_for_direct(settings)):
        yield (
            f'{" and ".join(asked)} ask for transport "direct", which a secured mesh has on one machine only, for '
            "nothing protects these connections: they are relayed; trust.direct = true in both modules allows them"
        )


def _asking_for_direct(settings: Settings) -> list[str]:
    """The settings that say ``direct``."""
    asked = [] if settings.transport is not Transport.DIRECT else ["bridge.transport"]
    if any(rule.values.get("transport") == Transport.DIRECT for rule in settings.contracts):
        asked.append("[[contract]]")
    rules = settings.services.rules
    if settings.services.transport is Transport.DIRECT or any(rule.transport is Transport.DIRECT for rule in rules):
        asked.append("[services]")
    return asked


# Seconds in which a program that has the core's port says whether it is a ROS master.
_ASKED: Final = 1.0


async def start_core(core: Core, settings: Settings) -> None:
    """Start the module's core.

    Raises:
        StartError: Its port is taken, or the address cannot be used; the text says how to join what has the port.
    """
    try:
        await core.start()
    except StartError as error:
        cause, port = error.__cause__, settings.core_port
        if not isinstance(cause, OSError) or cause.errno != errno.EADDRINUSE:
            raise
        if (agent := await asyncio.to_thread(_agent_at, port, settings.runtime_dir)) is not None:
            service = ", as the service: `rmpa service status`" if unit_of(agent.pid) else ""
            error.what, error.problem = "rmpa up", f"{agent.name} runs already (pid {agent.pid}{service})"
            error.remedy = (
                f"its nodes need ROS_MASTER_URI=http://localhost:{port}; a second module here needs another --name "
                "and --core-port"
            )
        elif await is_other_master(port):
            error.remedy = "join its graph with `rmpa up --core external`, or end it, or choose another --core-port"
        raise


def _agent_at(port: int, runtime_dir: str) -> AgentInfo | None:
    """The agent of this machine whose core has a port."""
    for found in find_agents({**os.environ, "RMPA_RUNTIME_DIR": runtime_dir} if runtime_dir else os.environ):
        with contextlib.suppress(RmpaError), ControlClient(found.path) as client:
            agent = client.agent()
            if agent.core_uri.rstrip("/").endswith(f":{port}"):
                return agent
    return None


async def is_other_master(port: int) -> bool:
    """Whether a ROS master without an agent answers at a port of this machine."""
    uri = f"http://127.0.0.1:{port}/"
    try:
        answers = (await call_api(uri, "getUri", OWN_NODE, timeout=_ASKED)).code == 1
        return answers and (await call_api(uri, "lookupNode", OWN_NODE, OWN_NODE, timeout=_ASKED)).code != 1
    except RmpaError:
        return False


def make_core(settings: Settings) -> Core:
    """The core that the settings ask for, not yet started.

    Raises:
        ConfigError: A ROS variable cannot be used.
    """
    if settings.core_mode == "embedded":
        state = core_file(os.environ, settings.core_port, settings.name, settings.state_dir)
        if state is None and settings.core_port:
            _log.warning("! the core keeps nothing when it restarts: set RMPA_STATE_DIR [no-state-directory]")
        return RosCore(
            settings.core_host,
            settings.core_port,
            state=state,
            keep=settings.core_keep,
            temporary=is_own,
        )
    uri = settings.core_master or DEFAULT_MASTER_URI
    # Proxies have the address that a node started in this shell would have. Where the shell asks for none, it is that
    # of the master: loopback if the master is only there, or the machine's name if the master goes by it, as that
    # works without a network.
    variables = {name: os.environ.get(name, "") for name in ("ROS_HOSTNAME", "ROS_IP")}
    environment = RosEnvironment.read(variables, (), local_addresses())
    address, master = environment.host, host_of(uri)
    if not environment.host_given and (is_loopback(master) or is_own_name(master)):
        address = "127.0.0.1" if is_loopback(master) else master
    host = "127.0.0.1" if is_loopback(address) else "0.0.0.0"  # noqa: S104 - as every node of such a graph does
    return ExternalCore(uri, own_node=OWN_NODE, node_host=host, node_address=address)


# The loggers that /rmpa/set_logger_level can set: the whole agent, or one room.
_ROOMS: Final = ("rmpa", "rmpa.agent", "rmpa.bridge", "rmpa.discovery", "rmpa.mesh", "rmpa.ros")
_LOGGERS: Final = {name: name for name in _ROOMS}


class Agent:
    """One module's agent: core, bridge and network, and the interfaces by which it is observed.

    Args:
        settings: Complete: the name is filled in.
        realtime: The outcomes of ``--realtime``, ready to read.
        load: Reads the settings again, as they were read for this agent; it may block.

    Attributes:
        trust: This module's part in a secured mesh; ``None``: trust is off.
        reloaded: Called when changed settings hold.
        other_notes: What else the snapshot's notes tell: of parts that the agent does not make itself.
        sites: Answers questions about other sites; a gateway answers them itself.
    """

    def __init__(
        self, settings: Settings, realtime: tuple[str, ...] = (), load: Callable[[], Loaded] | None = None
    ) -> None:
        self.settings = settings
        clock = SystemClock()
        membership = open_membership(settings, clock)
        self.core: Core = make_core(settings)
        self.bridge = Bridge(
            self.core,
            settings,
            rng=random.random,
            permissions=Permissions(settings.trust) if membership is not None else None,
        )
        self.params, self.services = Params(self.bridge), Services(self.bridge)
        nodes = Nodes(self.bridge, self.bridge.topics, self.services)
        subscriptions = Subscriptions(self.bridge)
        twins, rates = TwinWatch(self.bridge, subscriptions), Rates(self.bridge)
        for part in (self.params, self.services, nodes, subscriptions, twins, rates):
            self.bridge.add(part)
        self.trust: AgentTrust | None = None
        if membership is not None:
            self.trust = AgentTrust(settings, membership, self.bridge, clock)
            self.bridge.add(self.trust)
        self.network = Network(settings, self.bridge, self.trust)
        self.reloader = Reloader(settings, load, self.apply_settings, self.check_start)
        self.reloaded: Callable[[], None] = lambda: None
        self.other_notes: list[Callable[[], Iterable[str]]] = []
        counters = Counters()
        self._facts = facts = BridgeFacts(self.bridge, self.services, subscriptions, twins)
        self.snapshots = SnapshotBuilder(
            settings,
            core=self.core,
            facts=facts,
            endpoint=lambda: (at.identity, at.mesh, at.discovery) if (at := self.network.endpoint) else None,
            counters=counters,
            notes=self._notes,
            realtime=realtime,
            trust=self.trust.status if self.trust is not None else lambda: None,
            restart=lambda: restart_to_join(settings) if self.trust is None else "",
        )
        needs = Needs((), "the agent and its machine, nothing of the module's graph")
        self.bridge.rpc.on_request(INFO, lambda _asker, _args: self.snapshots.agent().for_peers(), needs)
        self.sites = SiteRequests(self.bridge)
        self.why = WhyService(settings.name, facts, self.snapshots, self.sites)
        answers = nodes, self.sites, rates
        self.operations = ControlOperations(settings.name, facts, self.params, self.snapshots, *answers)
        self.trust_commands = TrustCommands(
            settings, self.trust, lambda: at.identity if (at := self.network.endpoint) else None
        )
        handlers: dict[str, Handler] = {
            **self.operations.handlers(),
            "why": self.why.answer,
            "reload": lambda args: self.reloader.reload(check=args.get("check") is True),
            "graph": GraphRevisions(self.core, rows=settings.core_mode == "embedded").after,
            "trust": self.trust_commands.answer_command,
        }
        self.control = ControlServer(
            runtime_dir(os.environ, settings.runtime_dir),
            settings.name,
            handlers,
            counters=counters,
            group=control_group(settings.control_group),
        )

    async def start(self) -> None:
        """Start every part; the network comes last, so that peers find a complete agent.

        Raises:
            StartError: The name, the core's port or the mesh's port is taken.
        """
        for note in permission_notes(self.settings, secured=self.bridge.gate.on):
            _log.warning("! %s [doubtful-setting]", note)
        self._warn_of_stale_connections()
        async with contextlib.AsyncExitStack() as undo:
            self.control.lock()
            undo.push_async_callback(self.control.close)
            await start_core(self.core, self.settings)
            undo.push_async_callback(self.core.close)
            await self.bridge.start()
            undo.push_async_callback(self.bridge.close)
            diagnostics = Diagnostics(self._facts, self.snapshots)
            diagnostics.start()
            undo.callback(diagnostics.close)
            undo.callback(serve_loggers(self.bridge.node, self.core.call, _LOGGERS))
            await self.network.start()
            undo.push_async_callback(self.network.close)
            await self.control.start()
            freeze_heap()
            undo.callback(thaw_heap)
            self._undo = undo.pop_all()
        _log.info("= ROS_MASTER_URI=%s", shown_uri(self.core.uri))
        self.network.warn_if_open()

    async def close(self) -> None:
        """Close every part: the goodbye comes first, then the proxies leave the local graph, the core is last."""
        await self._undo.aclose()

    def _notes(self) -> Iterator[str]:
        yield from (f"{key} waits for a restart" for key in self.reloader.waiting)
        yield from self.params.notes()
        yield from permission_notes(self.settings, secured=self.bridge.gate.on)
        if self.trust is not None:
            yield from self.trust.notes()
        for notes in self.other_notes:
            yield from notes()

    def _warn_of_stale_connections(self) -> None:
        """Say beforehand what happens when the host of a direct subscriber vanishes, if the agent may not end it."""
        if self.settings.allows_direct and (problem := may_end_connections()):
            reason, _, remedy = problem.partition("; ")
            effect = "when that of a direct subscriber does, a rospy publisher without queue_size may hang"
            text = f"the agent may not end connections that a vanished host leaves behind ({reason}): {effect}"
            _log.warning("! %s; %s (docs/guides/direct-transport.md#cap_net_admin) [stale-connections]", text, remedy)

    async def check_start(self, running: Settings, new: Settings) -> None:
        """Check that this agent could start anew with settings that differ: its keys, the core's address, the ports.

        Raises:
            RmpaError: It could not, and why.
        """
        old, trust = running.trust, new.trust
        before = (running.name, running.state_dir, old.require, old.insecure)
        if (new.name, new.state_dir, trust.require, trust.insecure) != before:
            await asyncio.to_thread(open_membership, new, SystemClock())
        if new.core_mode == "embedded" and (new.core_host, new.core_port) != (running.core_host, running.core_port):
            port = 0 if self.core.uri.rstrip("/").endswith(f":{new.core_port}") else new.core_port  # its own is taken
            (await listen("ROS core", new.core_host, port, Use.CORE)).close()
        if new.port != running.port and new.port != getattr(self.network.endpoint, "port", None):
            for sock in open_mesh_port(new.port):
                sock.close()

    def apply_settings(self, settings: Settings) -> None:
        """Take settings that were read again; only live ones differ."""
        before, self.settings = self.settings, settings
        if not before.allows_direct:
            self._warn_of_stale_connections()
        logging.getLogger().setLevel(settings.log_level.upper())
        for part in (self.bridge, self.snapshots):
            part.reload(settings)
        self.reloaded()


async def _serve(
    settings: Settings,
    realtime: tuple[str, ...],
    load: Callable[[], Loaded] | None = None,
    started: Callable[[], None] = lambda: None,
) -> None:
    agent = Agent(settings, realtime, load)
    web = ChildProcess.web(settings, random.random)
    recorder = ChildProcess("record", "recording-stopped", settings, random.random)
    agent.reloaded = web.reload

    async def start() -> None:
        await agent.start()
        await asyncio.to_thread(started)
        for child, wanted in ((web, settings.web.enabled), (recorder, settings.record.enabled)):
            if wanted:
                child.begin()
            else:
                await child.stop()  # an agent before may have left it

    async def close() -> None:
        await asyncio.gather(web.stop(), recorder.stop())
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
