"""Runs the membership protocol on UDP sockets, with its timer, interfaces and seeds."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import random
import time
from dataclasses import dataclass
from functools import partial
from ipaddress import AddressValueError, IPv4Address
from typing import TYPE_CHECKING, Final

from rmpa.core.log import RefusalLog
from rmpa.core.statistics import Counters
from rmpa.discovery import limits, network
from rmpa.discovery.beacon import Address, Beacon, PacketFilter, Stranger
from rmpa.discovery.membership import MembershipProtocol, PeerEvent
from rmpa.runtime.loop import MachineTimer, call_at_tick, yield_to_data
from rmpa.runtime.tasks import end_tasks, keep_task

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable

    from rmpa.config.settings import Settings
    from rmpa.core.identity import Guid, Identity
    from rmpa.discovery.network import Interface
    from rmpa.trust.packets import PacketTrust

_log = logging.getLogger(__name__)

# Seconds for which a socket is not read when packets without a proof come faster than they can be looked at.
BEACONS_UNPROVED_PAUSE: Final = 0.05
# Packets handled in one callback, 100 microseconds each; pending data is handled between them.
_BEACONS_PER_WAKE: Final = 64

_ALL_NETWORKS: Final = ""
_ALONE: Final = "no interface that can carry multicast is up: other machines are only found by --seed"


@dataclass(eq=False)
class Discovery:
    """Finds the other agents of the domain, and makes this one known to them.

    It owns the membership protocol and all that this needs of the system, so it has more than twelve fields.

    Args:
        identity: This agent's own.
        settings: Group, port, domain, interfaces, seeds, and whether to use multicast.
        udp_socket: Bound to the mesh's port, non-blocking; lent, not closed here.
        on_event: Called in the loop with each event of the membership protocol, in order.
        on_interfaces: Called in the loop with all interfaces, used or not, after a change. Returns whether the
            identity still fits them; if not, ``close`` is about to be called, and nothing more is announced.
        look: Lists the interfaces.
        resolve: Looks up the host name of a seed; runs in a thread.
        trust: Of a secured mesh: beacons are signed, and only those of members are heard.

    Attributes:
        interfaces: The interfaces in use.
        membership: Which peers are there.
    """

    identity: Identity
    settings: Settings
    udp_socket: socket.socket
    on_event: Callable[[PeerEvent], None]
    on_interfaces: Callable[[tuple[Interface, ...]], bool] = lambda _: True
    look: Callable[[], tuple[Interface, ...]] = network.list_interfaces
    resolve: Callable[[str], list[str]] = network.resolve_ipv4
    trust: PacketTrust | None = None

    def __post_init__(self) -> None:
        settings = self.settings
        self.counters = Counters()
        self.interfaces: tuple[Interface, ...] = ()
        network.enlarge_buffer(self.udp_socket)
        self.membership = MembershipProtocol(
            self.identity, rng=random.random, multicast=settings.multicast.enabled, counters=self.counters
        )
        self._filter = PacketFilter(settings.domain, self.counters, self.membership.is_verified, self.trust)
        self._refusals = RefusalLog(_log, self.counters)
        self._group: Address = (settings.multicast.group, settings.discovery_port)
        self._sender = network.Sender(self.udp_socket, self._group, self.counters)
        self._everything: tuple[Interface, ...] = ()
        self._seed_hosts: dict[str, list[str]] = {}
        self._tasks: list[asyncio.Task[None]] = []
        self._receivers: list[socket.socket] = []
        # Those that are in the group, with the interfaces on which they have joined; one may have heartbeats alone.
        self._joined: dict[socket.socket, set[int]] = {}
        self._heartbeats: socket.socket | None = None
        self._heartbeats_tick: asyncio.TimerHandle | None = None
        self._warned: set[str] = set()
        self._timer = MachineTimer(self.membership.next_timer, self._timer_due)
        self._started = False
        self._flushing = False

    async def start(self) -> None:
        """Listen, and announce this agent. A socket that cannot be opened is logged; discovery works without it."""
        self._started = True
        self._listen(self.udp_socket, multicast=False)
        # Unicasts to the discovery port, the port of seeds without one; one agent of a machine gets them.
        self._open_receiver(_ALL_NETWORKS, multicast=False, lost="seeds of others must name our port")
        if self.settings.multicast.enabled:
            self._open_group()
        self._everything = self.look()
        self._use_interfaces()
        now = time.monotonic()
        self.membership.interfaces_changed(now, self._other_addresses())
        self.membership.start(now)
        self._flush()
        self._tasks = [keep_task(partial(network.watch_interfaces, self._look_again), "watch the interfaces")]
        for host in dict.fromkeys(seed.host for seed in self.settings.seeds):
            try:
                self._seed_hosts[host] = [str(IPv4Address(host))]
            except AddressValueError:
                follow = partial(network.follow_seed, host, self.resolve, self._seed_is)
                self._tasks.append(keep_task(follow, f"follow seed {host}"))
        self._set_seeds()

    async def close(self) -> None:
        """Send a goodbye and stop."""
        if not self._started:
            return
        self._started = False
        await end_tasks(*self._tasks)
        self._timer.close()
        self.membership.goodbye(time.monotonic())
        self._flush()
        loop = asyncio.get_running_loop()
        loop.remove_reader(self.udp_socket.fileno())
        for sock in self._receivers:
            loop.remove_reader(sock.fileno())
            sock.close()
        self._receivers.clear()
        self._joined.clear()
        if self._heartbeats_tick is not None:
            self._heartbeats_tick.cancel()

    def link_up(self, identity: Identity, endpoint: Address | None = None) -> None:
        """A link to this peer is up; for as long as it is, the peer is a member.

        Args:
            identity: As the link's handshake said.
            endpoint: Where the peer's beacons can be sent to, if that is known: its address and its mesh port
                (not the port of a connection that it dialled).
        """
        self.membership.link_up(identity, time.monotonic(), endpoint)
        self._flush()

    def link_down(self, guid: Guid, instance: bytes | None = None) -> None:
        """The link to this peer (to this run of it, if ``instance`` is given) fell."""
        self.membership.link_down(guid, time.monotonic(), instance)
        self._flush()

    def strangers(self) -> tuple[Stranger, ...]:
        """The modules that are heard and are not of this mesh."""
        return self._filter.strangers(time.monotonic())

    def notes(self) -> tuple[str, ...]:
        """Problems of the network, as texts for the user."""
        strangers = {host for one in self.strangers() for host, _ in one.identity.endpoints}
        silent = [
            f"seed {host}:{port}: no answer; is `rmpa up` running there, in domain {self.settings.domain} too, "
            "and its UDP port open?"
            for host, port in self.membership.silent_seeds()
            if host not in strangers
        ]
        full = self._filter.strangers_note(time.monotonic())
        return (*sorted(self._warned), *silent, *([full] if full else ()))

    def _open_group(self) -> None:
        """Receive multicasts: heartbeats by a socket of their own where the kernel can tell them from the others."""
        with contextlib.suppress(OSError):  # no filters; if it is the port, the other socket says so
            self._heartbeats = network.open_receiver(*self._group, heartbeats=True)
        others = None if self._heartbeats is None else False
        lost = "no multicast is heard; use --seed"
        sock = self._open_receiver(self._group[0], multicast=True, lost=lost, heartbeats=others)
        if self._heartbeats is not None:
            self._receivers.append(self._heartbeats)
            self._listen(self._heartbeats, multicast=True)
        self._joined = {each: set() for each in (sock, self._heartbeats) if each is not None}

    def _open_receiver(
        self, host: str, *, multicast: bool, lost: str, heartbeats: bool | None = None
    ) -> socket.socket | None:
        _, port = self._group
        try:
            sock = network.open_receiver(host, port, heartbeats=heartbeats)
        except OSError as error:
            text = f"cannot listen at {host or '*'}:{port} ({error.strerror}): {lost}, or choose another --multicast"
            self._warn(text, "multicast-blocked")
            return None
        self._receivers.append(sock)
        self._listen(sock, multicast=multicast)
        return sock

    def _readable(self, sock: socket.socket, *, multicast: bool) -> None:
        more = False
        if self._heartbeats is not None and (sock is self._heartbeats or self._heartbeats_tick is not None):
            more = self._take(self._heartbeats, multicast=True)  # first, as they were sent before what is read now
        if sock is not self._heartbeats:
            self._take(sock, multicast=multicast)
        elif not more and self.membership.size >= limits.HEARTBEATS_WAIT_MEMBERS:
            self._defer_heartbeats(sock)
        elif self._heartbeats_tick is not None:
            self._heartbeats_tick = None
            self._listen(sock, multicast=True)
        if self._filter.overrun:
            # A flood of forged packets must not take the core: for a while they stay in the kernel's buffer.
            self.counters.add("beacon.paused")
            self.membership.beacons_lost(time.monotonic())
            self._filter.overrun = False
            loop = asyncio.get_running_loop()
            loop.remove_reader(sock.fileno())
            loop.call_later(BEACONS_UNPROVED_PAUSE, partial(self._listen, sock, multicast=multicast))
        self._flush()

    def _listen(self, sock: socket.socket, *, multicast: bool) -> None:
        if self._started:
            asyncio.get_running_loop().add_reader(sock.fileno(), partial(self._readable, sock, multicast=multicast))

    def _defer_heartbeats(self, sock: socket.socket) -> None:
        """Read the next heartbeats at a common time of the process: it wakes once for those of many members."""
        asyncio.get_running_loop().remove_reader(sock.fileno())
        if self._heartbeats_tick is not None:
            self._heartbeats_tick.cancel()
        read = partial(self._readable, sock, multicast=True)
        self._heartbeats_tick = call_at_tick(limits.HEARTBEATS_WAIT, read)

    def _take(self, sock: socket.socket, *, multicast: bool) -> bool:
        """Handle a bounded number of packets, with pending data between them: a flood must not delay data.

        Returns:
            Whether there may be more.
        """
        now = time.monotonic()
        for _ in range(_BEACONS_PER_WAKE):
            yield_to_data()
            try:
                data, source, index = network.receive(sock)
            except BlockingIOError:
                return False
            except OSError as error:  # an ICMP error that some earlier packet of ours caused
                _log.debug("< %s", error)
                continue
            packet = self._filter.parse(data, source, now, multicast=multicast, interface=index)
            if packet is not None:
                beacon, old_key = packet
                _log.debug("< %s:%d (interface %d): %s", *source, index, beacon)
                if old_key is None:
                    self.membership.receive(beacon, source, now, multicast=multicast)
                else:
                    self.membership.recognise(beacon, source, old_key)
            elif self._filter.overrun:
                return False
        return True

    def _look_again(self) -> bool:
        """Act on a change of the interfaces; return whether they could be listed."""
        try:
            everything = self.look()
        except OSError as error:  # no file descriptor is left to ask the kernel
            _log.debug("! interfaces cannot be listed: %s", error)
            return False
        if everything != self._everything:
            self._everything = everything
            self._use_interfaces()
            if self.on_interfaces(everything):
                self.membership.interfaces_changed(time.monotonic(), self._other_addresses())
                self._flush()
        return True

    def _other_addresses(self) -> tuple[IPv4Address, ...]:
        wanted = self.settings.interfaces
        mine = [i for i in self._everything if i.up and (not wanted or i.name in wanted)]
        return network.further_addresses(mine, self.identity.guid.address)

    def _use_interfaces(self) -> None:
        """Choose the usable interfaces, and join the group on them."""
        wanted = self.settings.interfaces
        before, self.interfaces = self.interfaces, network.choose(self._everything, wanted)
        if problem := network.unknown_names(self._everything, wanted):
            self._warn(problem, "no-interface")
        if not self.settings.multicast.enabled:
            return
        if self.interfaces != before:
            _log.info("= multicast %s:%d on %s", *self._group, ", ".join(map(str, self.interfaces)) or "no interface")
        if any(not i.loopback for i in self.interfaces) or (wanted and self.interfaces):
            self._warned.discard(_ALONE)
        else:
            self._warn(_ALONE, "no-interface")
        for sock, joined in self._joined.items():
            refused = network.join_group(sock, self._group[0], self.interfaces, joined)
            for name, error in refused.items():
                text = f"{name}: the group cannot be joined ({error.strerror}); tried again when it changes"
                self._warn(text, network.failure_code(error))

    def _seed_is(self, host: str, addresses: list[str]) -> None:
        if addresses != self._seed_hosts.get(host):
            _log.info("= seed %s is %s", host, ", ".join(addresses))
            self._seed_hosts[host] = addresses
            self._set_seeds()

    def _set_seeds(self) -> None:
        default = self.settings.discovery_port
        seeds = self.settings.seeds
        self.membership.set_seeds((a, s.port or default) for s in seeds for a in self._seed_hosts.get(s.host, ()))
        self._flush()

    def _warn(self, text: str, code: str) -> None:
        if text not in self._warned:
            self._warned.add(text)
            _log.warning("! %s [%s]", text, code)

    def _flush(self) -> None:
        """Send the outputs, deliver the events, set the timer. A handler of an event may call this again."""
        if self._flushing:
            return
        self._flushing = True
        try:
            while True:
                outputs, events = self.membership.outputs(), self.membership.events()
                if not (outputs or events):
                    break
                for beacon, address, key in outputs:
                    yield_to_data()
                    self._send(beacon, address, key)
                for event in events:
                    yield_to_data()
                    if event.change == "conflict":
                        host = str(event.identity.guid.address)
                        self._refusals.refuse(time.monotonic(), f"conflict.{event.reason}", host, event.text)
                    self.on_event(event)
        finally:
            self._flushing = False
            if self._started:
                self._timer.arm()

    def _send(self, beacon: Beacon, address: Address | None, key: int) -> None:
        """Send a beacon, signed in a secured mesh; the arguments as for ``endpoints.OutgoingBeacon``."""
        packet = beacon.serialize()
        if self.trust is not None:
            packet = self.trust.sign(packet, time.monotonic(), key)
        if address is None:
            _log.debug("> group: %s", beacon)
            self._sender.multicast(packet, self.interfaces)
        else:
            _log.debug("> %s:%d: %s", *address, beacon)
            self._sender.unicast(packet, address)

    def _timer_due(self, now: float) -> None:
        self.membership.handle_timer(now)
        self._flush()
