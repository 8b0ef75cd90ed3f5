"""Runs the membership protocol: UDP sockets, timer, interfaces and seeds."""

from __future__ import annotations

import asyncio
import logging
import random
from functools import partial
from typing import TYPE_CHECKING, Final

from rmpa.core.counters import Counters, RefusalLog
from rmpa.discovery import limits
from rmpa.discovery.beacon import Beacon
from rmpa.discovery.events import PeerConflict, SendMulticast
from rmpa.discovery.io import sockets
from rmpa.discovery.io.interfaces import (
    Interface,
    InterfaceWatcher,
    choose,
    further_addresses,
    list_interfaces,
    unknown_names,
)
from rmpa.discovery.io.packet_filter import PacketFilter
from rmpa.discovery.io.seeds import SeedResolver, resolve_ipv4
from rmpa.discovery.membership import MembershipProtocol
from rmpa.runtime.loop import MachineTimer, SystemClock, yield_to_data
from rmpa.trust.packets import KeyPurpose

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable
    from ipaddress import IPv4Address

    from rmpa.config.settings import Settings
    from rmpa.core.counters import Clock
    from rmpa.core.identity import Guid, Identity
    from rmpa.discovery.beacon import Address
    from rmpa.discovery.events import Event, Output, PeerView
    from rmpa.discovery.strangers import Stranger
    from rmpa.trust.packets import PacketTrust

_log = logging.getLogger(__name__)

_ALL_NETWORKS: Final = ""
_ALONE: Final = "no interface that can carry multicast is up: other machines are only found by --seed"


class Discovery:
    """Finds the other agents of the domain, and makes this one known to them.

    Args:
        identity: This agent's own.
        settings: Group, port, domain, interfaces, seeds, and whether to use multicast.
        udp_socket: Bound to the mesh's port, non-blocking; lent, not closed here.
        on_event: Called in the loop with each event of the membership protocol, in order.
        on_interfaces: Called in the loop with all interfaces, used or not, after a change. Returns whether the
            identity still fits them; if not, ``close`` is about to be called, and nothing more is announced.
        clock: The source of monotonic seconds.
        look: Lists the interfaces.
        resolve: Looks up the host name of a seed; runs in a thread.
        trust: Of a secured mesh: beacons are signed, and only those of members are heard.
    """

    def __init__(
        self,
        identity: Identity,
        settings: Settings,
        udp_socket: socket.socket,
        *,
        on_event: Callable[[Event], None],
        on_interfaces: Callable[[tuple[Interface, ...]], bool] = lambda _: True,
        clock: Clock | None = None,
        look: Callable[[], tuple[Interface, ...]] = list_interfaces,
        resolve: Callable[[str], list[str]] = resolve_ipv4,
        trust: PacketTrust | None = None,
    ) -> None:
        self._trust = trust
        self.counters = Counters()
        self._identity = identity
        self._settings = settings
        self._udp = udp_socket
        sockets.enlarge_buffer(udp_socket)
        self._on_event = on_event
        self._on_interfaces = on_interfaces
        self._clock: Clock = clock if clock is not None else SystemClock()
        self._membership = MembershipProtocol(
            identity,
            rng=random.random,
            multicast=settings.multicast.enabled,
            counters=self.counters,
        )
        self._filter = PacketFilter(
            settings.domain, self.counters, is_verified=self._membership.is_verified, trust=trust
        )
        self._refusals = RefusalLog(_log, self.counters)
        self._group: Address = (settings.multicast.group, settings.discovery_port)
        self._sender = sockets.Sender(udp_socket, self._group, self.counters)
        self._watcher = InterfaceWatcher(self._interfaces_changed, look=look)
        self._seeds = SeedResolver(settings.seeds, settings.discovery_port, self._seeds_changed, resolve=resolve)
        self._interfaces: tuple[Interface, ...] = ()
        self._receivers: list[socket.socket] = []
        self._joined: sockets.GroupMembership | None = None
        self._warned: set[str] = set()
        self._timer = MachineTimer(self._membership.next_timer, self._timer_due, now=self._clock.now)
        self._started = False
        self._flushing = False

    # --- life -------------------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Listen, and announce this agent. A socket that cannot be opened is logged; discovery works without it."""
        self._started = True
        loop = asyncio.get_running_loop()
        loop.add_reader(self._udp.fileno(), partial(self._readable, self._udp, multicast=False))
        self._open_seed_port()
        if self._settings.multicast.enabled:
            self._open_group()
        everything = self._watcher.start()
        self._use(everything)
        now = self._clock.now()
        self._membership.interfaces_changed(now, self._other_addresses(everything))
        self._membership.start(now)
        self._flush()
        self._seeds.start()

    async def close(self) -> None:
        """Send a goodbye and stop."""
        if not self._started:
            return
        self._started = False
        self._watcher.close()
        await self._seeds.close()
        self._timer.close()
        self._membership.goodbye(self._clock.now())
        self._flush()
        loop = asyncio.get_running_loop()
        loop.remove_reader(self._udp.fileno())
        for sock in self._receivers:
            loop.remove_reader(sock.fileno())
            sock.close()
        self._receivers.clear()
        self._joined = None

    # --- links ------------------------------------------------------------------------------------------------

    def link_up(self, identity: Identity, endpoint: Address | None = None) -> None:
        """A link to this peer is up; for as long as it is, the peer is a member.

        Args:
            identity: As the link's handshake said.
            endpoint: Where the peer's beacons can be sent to, if that is known: its address and its mesh port
                (not the port of a connection that it dialled).
        """
        self._membership.link_up(identity, self._clock.now(), endpoint)
        self._flush()

    def link_down(self, guid: Guid, instance: bytes | None = None) -> None:
        """The link to this peer (to this run of it, if ``instance`` is given) fell."""
        self._membership.link_down(guid, self._clock.now(), instance)
        self._flush()

    def peers(self) -> tuple[PeerView, ...]:
        """All known peers, in GUID order."""
        return self._membership.peers()

    def strangers(self) -> tuple[Stranger, ...]:
        """The modules that are heard and are not of this mesh."""
        return self._filter.strangers.shown(self._clock.now())

    @property
    def interfaces(self) -> tuple[Interface, ...]:
        """The interfaces in use."""
        return self._interfaces

    @property
    def identity(self) -> Identity:
        """This agent's own, with its present addresses."""
        return self._membership.identity

    # --- sockets ----------------------------------------------------------------------------------------------

    def _open_seed_port(self) -> None:
        """Receive unicasts to the discovery port, the port of seeds without one; one agent of a machine gets them."""
        self._receiver(_ALL_NETWORKS, multicast=False, lost="seeds of others must name our port")

    def _open_group(self) -> None:
        sock = self._receiver(self._group[0], multicast=True, lost="no multicast is heard; use --seed")
        if sock is not None:
            self._joined = sockets.GroupMembership(sock, self._group[0])

    def _receiver(self, host: str, *, multicast: bool, lost: str) -> socket.socket | None:
        port = self._group[1]
        try:
            sock = sockets.open_receiver(host, port)
        except OSError as error:
            self._warn(
                f"cannot listen at {host or '*'}:{port} ({error.strerror}): {lost}, or choose another --multicast"
            )
            return None
        self._receivers.append(sock)
        asyncio.get_running_loop().add_reader(sock.fileno(), partial(self._readable, sock, multicast=multicast))
        return sock

    def _readable(self, sock: socket.socket, *, multicast: bool) -> None:
        self._take(sock, multicast=multicast)
        if self._filter.overrun:
            self._pause(sock, multicast=multicast)
        self._flush()

    def _take(self, sock: socket.socket, *, multicast: bool) -> None:
        """Handle a bounded number of packets, with pending data between them: a flood must not delay data."""
        now = self._clock.now()
        for _ in range(limits.BEACONS_PER_WAKE):
            yield_to_data()
            try:
                data, source, index = sockets.receive(sock)
            except (BlockingIOError, InterruptedError):
                return
            except OSError as error:  # an ICMP error that some earlier packet of ours caused
                _log.debug("< %s", error)
                continue
            packet = self._filter.parse(data, source, now, multicast=multicast, interface=index)
            if packet is not None:
                _log.debug("< %s:%d (interface %d): %s", *source, index, packet)
                if isinstance(packet, Beacon):
                    self._membership.receive(packet, source, now, multicast=multicast)
                else:
                    self._membership.recognise(packet.beacon, source, packet.key)
            elif self._filter.overrun:
                return

    def _pause(self, sock: socket.socket, *, multicast: bool) -> None:
        """Leave what comes to the kernel's buffer for a while: a flood of forged packets must not take the core."""
        self.counters.add("beacon.paused")
        self._filter.overrun = False
        loop = asyncio.get_running_loop()
        loop.remove_reader(sock.fileno())
        loop.call_later(limits.BEACONS_UNPROVED_PAUSE, partial(self._resume, sock, multicast=multicast))

    def _resume(self, sock: socket.socket, *, multicast: bool) -> None:
        if self._started:
            asyncio.get_running_loop().add_reader(sock.fileno(), partial(self._readable, sock, multicast=multicast))

    # --- interfaces and seeds ---------------------------------------------------------------------------------

    def _interfaces_changed(self, everything: tuple[Interface, ...]) -> None:
        self._use(everything)
        if not self._on_interfaces(everything):
            return
        self._membership.interfaces_changed(self._clock.now(), self._other_addresses(everything))
        self._flush()

    def notes(self) -> tuple[str, ...]:
        """Problems of the network, as texts for the user."""
        strangers = {host for one in self.strangers() for host, _ in one.identity.endpoints}
        silent = [
            f"seed {host}:{port}: no answer; is `rmpa up` running there, in domain {self._settings.domain} too, "
            "and its UDP port open?"
            for host, port in self._membership.silent_seeds()
            if host not in strangers
        ]
        return (*sorted(self._warned), *silent)

    def _other_addresses(self, everything: tuple[Interface, ...]) -> tuple[IPv4Address, ...]:
        wanted = self._settings.interfaces
        mine = [i for i in everything if i.up and (not wanted or i.name in wanted)]
        return further_addresses(mine, self._identity.guid.address)

    def _use(self, everything: tuple[Interface, ...]) -> None:
        """Choose the usable interfaces, and join the group on them."""
        wanted = self._settings.interfaces
        before = self._interfaces
        self._interfaces = choose(everything, wanted)
        if problem := unknown_names(everything, wanted):
            self._warn(problem)
        if not self._settings.multicast.enabled:
            return
        if self._interfaces != before:
            _log.info("= multicast %s:%d on %s", *self._group, ", ".join(map(str, self._interfaces)) or "nothing")
        if any(not i.loopback for i in self._interfaces) or (wanted and self._interfaces):
            self._warned.discard(_ALONE)
        else:
            self._warn(_ALONE)
        if self._joined is not None:
            for name, error in self._joined.update(self._interfaces).items():
                self._warn(f"{name}: the group cannot be joined ({error.strerror}); tried again when it changes")

    def _seeds_changed(self, addresses: tuple[Address, ...]) -> None:
        self._membership.set_seeds(addresses)
        self._flush()

    def _warn(self, text: str) -> None:
        if text not in self._warned:
            self._warned.add(text)
            _log.warning("! %s", text)

    # --- outputs and events -----------------------------------------------------------------------------------

    def _flush(self) -> None:
        """Send the outputs, deliver the events, set the timer. A handler of an event may call this again."""
        if self._flushing:
            return
        self._flushing = True
        try:
            while True:
                if beacons := self._membership.outputs():
                    self._send(beacons)
                    continue
                events = self._membership.events()
                for event in events:
                    yield_to_data()
                    self._deliver(event)
                if not events:
                    break
        finally:
            self._flushing = False
            if self._started:
                self._timer.arm()

    def _send(self, outputs: list[Output]) -> None:
        for output in outputs:
            yield_to_data()
            if isinstance(output, SendMulticast):
                _log.debug("> group: %s", output.beacon)
                self._sender.multicast(self._packet(output.beacon), self._interfaces)
            else:
                _log.debug("> %s:%d: %s", *output.address, output.beacon)
                self._sender.unicast(self._packet(output.beacon, output.key), output.address)

    def _packet(self, beacon: Beacon, key: int = 0) -> bytes:
        """The bytes of a beacon, signed in a secured mesh; ``key`` as for ``SendUnicast``."""
        trust = self._trust
        if trust is None:
            return beacon.serialize()
        packet = beacon.serialize()
        return trust.signer.sign(packet, KeyPurpose.BEACON, self._clock.now(), trust.wall(), key=key)

    def _deliver(self, event: Event) -> None:
        if isinstance(event, PeerConflict):
            host = str(event.identity.guid.address)
            self._refusals.refuse(self._clock.now(), f"conflict.{event.kind.name.lower()}", host, str(event))
        self._on_event(event)

    def _timer_due(self, now: float) -> None:
        self._membership.handle_timer(now)
        self._flush()
