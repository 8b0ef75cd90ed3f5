"""Runs the membership protocol on UDP sockets, with its timer, interfaces and seeds; judges packets first."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import random
import time
from dataclasses import dataclass
from functools import partial
from ipaddress import AddressValueError, IPv4Address
from typing import TYPE_CHECKING, Final

from rmpa.core.counters import Counters, RefusalLog, TokenBucket
from rmpa.core.errors import RemoteProtocolError
from rmpa.discovery import limits, network
from rmpa.discovery.announcing import AddressLimit
from rmpa.discovery.beacon import (
    INSTANCE_AT,
    MALFORMED,
    OTHER_DOMAIN,
    OTHER_VERSION,
    VERSION,
    Beacon,
    BeaconKind,
    BeaconRefused,
    sender_of,
)
from rmpa.discovery.membership import MembershipProtocol
from rmpa.runtime.loop import MachineTimer, call_at_tick, yield_to_data
from rmpa.runtime.tasks import end_tasks, keep_task
from rmpa.trust import limits as trust_limits
from rmpa.trust.packets import Verdict
from rmpa.trust.permissions import TrustReason, not_of_this_mesh

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable

    from rmpa.config.settings import Settings
    from rmpa.core.counters import Yielder
    from rmpa.core.identity import Guid, Identity
    from rmpa.discovery.beacon import Address
    from rmpa.discovery.endpoints import PeerView
    from rmpa.discovery.membership import PeerEvent
    from rmpa.discovery.network import Interface
    from rmpa.trust.packets import PacketTrust, Verification

_log = logging.getLogger(__name__)

# Seconds for which a socket is not read when packets without a proof come faster than they can be looked at.
BEACONS_UNPROVED_PAUSE: Final = 0.05
# How long a module that is not of this mesh is shown after its last beacon: six heartbeats.
STRANGER_KEPT: Final = 30.0

# Packets handled in one callback, 100 microseconds each; pending data is handled between them.
_BEACONS_PER_WAKE: Final = 64
# Packets a second without a valid proof that an agent of a secured mesh looks at: 37 microseconds each, 15 % of a
# core. Above it the socket is not read for a while, and the kernel drops what does not fit its buffer: beacons of
# members too, which are then sent more often (``MembershipProtocol.beacons_lost``), and which links do not need.
_BEACONS_UNPROVED_PER_SECOND: Final = 4000.0
# Refused beacons a second that are parsed for the names of their senders: 0.1 % of a core.
_STRANGER_BEACONS_PER_SECOND: Final = 50.0
# Source addresses whose packets are counted; the oldest is forgotten first.
_BEACON_SOURCES_MAX: Final = 4096

_INTERFACES: Final = 256
# What is told of the senders of packets that are refused; others are only counted.
_REFUSED: Final = {
    Verdict.UNTAGGED: TrustReason.UNSECURED,
    Verdict.UNKNOWN_KEY: TrustReason.KEY,
    Verdict.FORGED: TrustReason.FOREIGN,
}


@dataclass(slots=True)
class Stranger:
    """A module that is heard in the network and is not of this mesh. Nothing that it says is proved.

    Args:
        identity: As its last beacon said.
        problem: Why its beacons are refused, and what to do.
        reason: Likewise, as a word; ``REVOKED``: it has a group key from before a revocation, and the deny list says
            whether that was its own. ``None``: its clock, or its release.
        since: When it was first heard, monotonic seconds.
        heard: When it was last heard.
    """

    identity: Identity
    problem: str
    reason: TrustReason | None
    since: float
    heard: float


class PacketFilter:
    """Parses the packets of the discovery sockets; those that are dropped are counted.

    Dropped are floods, and in a secured mesh packets without a valid proof. A packet that comes by two interfaces is
    parsed twice; its number shows the membership protocol that it is a repeat.

    Args:
        domain: This agent's domain id.
        counters: ``beacon.in``, ``beacon.flood``, ``beacon.unlinked_limited``,
            ``beacon.other_domain``, ``beacon.version``, ``beacon.malformed``.
        is_verified: Whether a run of a peer has or had a link: beacons of such peers, and echoes of this agent's
            own, are not limited in rate.
        trust: Of a secured mesh: only packets whose trailer is accepted are parsed; ``beacon.untagged``,
            ``beacon.forged`` and so on count the others.

    Attributes:
        overrun: Whether packets without a valid proof come faster than they can be looked at: pause the reading.
    """

    def __init__(
        self,
        domain: int,
        counters: Counters,
        *,
        is_verified: Callable[[Guid, bytes], bool] = lambda *_: False,
        trust: PacketTrust | None = None,
    ) -> None:
        self._trust = trust
        self._domain = domain
        self._counters = counters
        self._is_verified = is_verified
        self._refusals = RefusalLog(_log, counters)
        # The limits, one for each kind of packet and each kind of sender: they are more than twelve fields together.
        self._unlinked: dict[int, TokenBucket] = {}
        self._unproved = TokenBucket(_BEACONS_UNPROVED_PER_SECOND, limits.BEACONS_UNPROVED_BURST)
        self._sources = AddressLimit(limits.BEACONS_PER_SOURCE, _BEACON_SOURCES_MAX)
        self._old_key_sources = AddressLimit(trust_limits.OLD_KEY_PACKETS_PER_ADDRESS, trust_limits.OLD_KEYS_MAX)
        self._old_keys = TokenBucket(trust_limits.OLD_KEY_PACKETS_RATE, trust_limits.OLD_KEY_PACKETS_RATE)
        self._strangers: dict[tuple[str, int], Stranger] = {}
        self._left_out = -math.inf
        self._stranger_beacons = TokenBucket(_STRANGER_BEACONS_PER_SECOND, _STRANGER_BEACONS_PER_SECOND)
        self.overrun = False

    def parse(
        self, data: bytes, source: Address, now: float, *, multicast: bool, interface: int = 0
    ) -> tuple[Beacon, int | None] | None:
        """What a packet contains; ``None`` if it is dropped, which is counted and, where it helps, logged.

        Other domains have other ports, so their multicasts are ignored silently. A unicast of another domain is
        logged: its sender was given this address by a user, and waits for an answer.

        Args:
            data: The packet.
            source: The address and port it came from.
            now: Monotonic seconds.
            multicast: Whether it came to the group.
            interface: The index of the interface it came in by: each has a limit of its own.

        Returns:
            The beacon; and the low 16 bits of the number of the older group key by which it is signed: then nothing
            in it is proved. ``None`` in place of them: it is of a member.
        """
        host, _ = source
        # First, where there is a proof: packets with the forged source of a member must not count as its flood.
        if self._trust is not None:
            if len(data) > limits.BEACON_MAX_BYTES:
                self._counters.add(MALFORMED)
                return None
            proof = self._trust.verify(data, INSTANCE_AT, now)
            if proof.verdict is not Verdict.ACCEPTED:
                return self._parse_unproved(proof, data, host, now)
        if not self._sources.take(host, now):
            text = f"{host} sends too many packets to the discovery port; the rest is ignored"
            self._refusals.refuse(now, "beacon.flood", host, text)
            return None
        beacon = self._read(data, host, now, multicast=multicast, interface=interface)
        return None if beacon is None else (beacon, None)

    def strangers(self, now: float) -> tuple[Stranger, ...]:
        """The modules whose beacons are refused and were heard lately, in the order in which they were found."""
        for key in [key for key, one in self._strangers.items() if now - one.heard > STRANGER_KEPT]:
            del self._strangers[key]
        return tuple(self._strangers.values())

    def strangers_note(self, now: float) -> str:
        """What a user is told while more such modules are heard than are shown; empty: all are shown."""
        if now - self._left_out > STRANGER_KEPT or len(self.strangers(now)) < limits.STRANGERS_SHOWN:
            return ""
        return (
            f"{limits.STRANGERS_SHOWN} modules that are not of this mesh are shown, which is the most; further ones "
            f"are heard, and not shown until one of these was silent for {STRANGER_KEPT:.0f} s"
        )

    def _read(self, data: bytes, host: str, now: float, *, multicast: bool, interface: int) -> Beacon | None:
        """Parse a packet within the limits of its sender."""
        try:
            verified = self._is_verified(*sender_of(data, self._domain))
            if not verified and not self._unlinked_limit(interface).take(now):
                self._counters.add("beacon.unlinked_limited")
                return None
            packet = Beacon.parse(data, self._domain)
        except RemoteProtocolError as error:
            counter = error.counter if isinstance(error, BeaconRefused) else MALFORMED
            if counter == OTHER_DOMAIN and multicast:
                self._counters.add(counter)
                return None
            foreign = f"from {host}: {error}; is another program there?"
            text = foreign if counter == MALFORMED else f"the peer at {host} {error}"
            self._refusals.refuse(now, counter, host, text)
            if counter == OTHER_VERSION:
                # Its name, if another release has it where this one does: a peer list without it would be a riddle.
                self._stranger(data[:4] + bytes([VERSION]) + data[5:], str(error), now)
            return None
        self._counters.add("beacon.in")
        return packet

    def _parse_unproved(
        self, proof: Verification, data: bytes, host: str, now: float
    ) -> tuple[Beacon, int | None] | None:
        """What a packet contains that no member of the secured mesh sent just now, but perhaps a former member.

        Nothing is remembered of other packets, so that forged ones cannot push out what is remembered of real ones.
        """
        verdict = proof.verdict
        if verdict is Verdict.OLD_KEY:
            # One address must not use up what there is for all.
            if self._old_key_sources.take(host, now) and self._old_keys.take(now):
                beacon = self._parsed(data)
                self._counters.add("beacon.old_key" if beacon is not None else MALFORMED)
                if beacon is None:
                    return None
                self._show(beacon, "", TrustReason.REVOKED, now)
                return beacon, proof.key
            self._counters.add("beacon.limited")
        self.overrun = not self._unproved.take(now)
        if verdict is Verdict.OLD_KEY:
            return None
        problem = _problem(proof)
        identity = self._stranger(data, problem, now, _REFUSED.get(verdict)) if problem else None
        if identity is not None:
            at = str(identity.guid.address)  # that of the packet is another one by each interface of a machine
            self._refusals.refuse(now, f"beacon.{verdict}", at, f"{identity.name} at {host} is {problem}")
        else:
            self._counters.add(f"beacon.{verdict}")
        return None

    def _parsed(self, data: bytes) -> Beacon | None:
        try:
            return Beacon.parse(data, self._domain)
        except RemoteProtocolError:
            return None

    def _stranger(self, data: bytes, problem: str, now: float, reason: TrustReason | None = None) -> Identity | None:
        """Take in a refused packet; return its sender if that is shown.

        One of the two modules has not joined a mesh, or is of another release.
        """
        beacon = self._parsed(data) if self._stranger_beacons.take(now) else None
        return None if beacon is None else self._show(beacon, problem, reason, now)

    def _show(self, beacon: Beacon, problem: str, reason: TrustReason | None, now: float) -> Identity | None:
        """Remember the sender of a beacon without a proof: few are, so a full table takes no more."""
        identity = beacon.identity
        key = identity.name, identity.guid.place
        if beacon.kind is BeaconKind.GOODBYE:
            self._strangers.pop(key, None)
            return None
        if key not in self._strangers and len(self.strangers(now)) >= limits.STRANGERS_SHOWN:
            self._left_out = now
            return None
        since = self._strangers[key].since if key in self._strangers else now
        self._strangers[key] = Stranger(identity, problem, reason, since, now)
        return identity

    def _unlinked_limit(self, interface: int) -> TokenBucket:
        """The limit of packets of unlinked peers on this interface."""
        bucket = self._unlinked.get(interface)
        if bucket is None:
            if len(self._unlinked) >= _INTERFACES:
                self._unlinked.clear()  # interfaces of containers come and go, each with a new index
            rate, burst = limits.BEACONS_UNLINKED_PER_SECOND, limits.BEACONS_UNLINKED_BURST
            bucket = self._unlinked[interface] = TokenBucket(rate, burst)
        return bucket


def _problem(found: Verification) -> str:
    """What is told of the sender of a packet that is refused; empty: it is only counted."""
    if found.verdict is Verdict.CLOCK:
        ahead = "ahead of" if found.skew > 0 else "behind"
        return f"refused: its clock is {abs(found.skew)} s {ahead} ours, or its beacons are replayed; set both clocks"
    return not_of_this_mesh(_REFUSED[found.verdict]) if found.verdict in _REFUSED else ""


_ALL_NETWORKS: Final = ""
_ALONE: Final = "no interface that can carry multicast is up: other machines are only found by --seed"


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
    """

    def __init__(
        self,
        identity: Identity,
        settings: Settings,
        udp_socket: socket.socket,
        *,
        on_event: Callable[[PeerEvent], None],
        on_interfaces: Callable[[tuple[Interface, ...]], bool] = lambda _: True,
        look: Callable[[], tuple[Interface, ...]] = network.list_interfaces,
        resolve: Callable[[str], list[str]] = network.resolve_ipv4,
        trust: PacketTrust | None = None,
    ) -> None:
        self._trust = trust
        self.counters = Counters()
        self.interfaces: tuple[Interface, ...] = ()
        self._identity = identity
        self._settings = settings
        self._udp = udp_socket
        network.enlarge_buffer(udp_socket)
        self._on_event = on_event
        self._on_interfaces = on_interfaces
        self._look = look
        self._resolve = resolve
        self._membership = MembershipProtocol(
            identity, rng=random.random, multicast=settings.multicast.enabled, counters=self.counters
        )
        self._filter = PacketFilter(
            settings.domain, self.counters, is_verified=self._membership.is_verified, trust=trust
        )
        self._refusals = RefusalLog(_log, self.counters)
        self._group: Address = (settings.multicast.group, settings.discovery_port)
        self._sender = network.Sender(udp_socket, self._group, self.counters)
        self._everything: tuple[Interface, ...] = ()
        self._seed_hosts: dict[str, list[str]] = {}
        self._tasks: list[asyncio.Task[None]] = []
        self._receivers: list[socket.socket] = []
        # Those that are in the group, with the interfaces on which they have joined; one may have heartbeats alone.
        self._joined: dict[socket.socket, set[int]] = {}
        self._heartbeats: socket.socket | None = None
        self._heartbeats_tick: asyncio.TimerHandle | None = None
        self._warned: set[str] = set()
        self._timer = MachineTimer(self._membership.next_timer, self._timer_due)
        self._started = False
        self._flushing = False

    # --- life -------------------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Listen, and announce this agent. A socket that cannot be opened is logged; discovery works without it."""
        self._started = True
        self._listen(self._udp, multicast=False)
        # Unicasts to the discovery port, the port of seeds without one; one agent of a machine gets them.
        self._open_receiver(_ALL_NETWORKS, multicast=False, lost="seeds of others must name our port")
        if self._settings.multicast.enabled:
            self._open_group()
        self._everything = self._look()
        self._use_interfaces()
        now = time.monotonic()
        self._membership.interfaces_changed(now, self._other_addresses())
        self._membership.start(now)
        self._flush()
        self._tasks = [keep_task(partial(network.watch_interfaces, self._look_again), "watch the interfaces")]
        for host in dict.fromkeys(seed.host for seed in self._settings.seeds):
            try:
                self._seed_hosts[host] = [str(IPv4Address(host))]
            except AddressValueError:
                follow = partial(network.follow_seed, host, self._resolve, self._seed_is)
                self._tasks.append(keep_task(follow, f"follow seed {host}"))
        self._set_seeds()

    async def close(self) -> None:
        """Send a goodbye and stop."""
        if not self._started:
            return
        self._started = False
        await end_tasks(*self._tasks)
        self._timer.close()
        self._membership.goodbye(time.monotonic())
        self._flush()
        loop = asyncio.get_running_loop()
        loop.remove_reader(self._udp.fileno())
        for sock in self._receivers:
            loop.remove_reader(sock.fileno())
            sock.close()
        self._receivers.clear()
        self._joined.clear()
        if self._heartbeats_tick is not None:
            self._heartbeats_tick.cancel()

    # --- links and views --------------------------------------------------------------------------------------

    def link_up(self, identity: Identity, endpoint: Address | None = None) -> None:
        """A link to this peer is up; for as long as it is, the peer is a member.

        Args:
            identity: As the link's handshake said.
            endpoint: Where the peer's beacons can be sent to, if that is known: its address and its mesh port
                (not the port of a connection that it dialled).
        """
        self._membership.link_up(identity, time.monotonic(), endpoint)
        self._flush()

    def link_down(self, guid: Guid, instance: bytes | None = None) -> None:
        """The link to this peer (to this run of it, if ``instance`` is given) fell."""
        self._membership.link_down(guid, time.monotonic(), instance)
        self._flush()

    def peers(self, yielder: Yielder = iter) -> list[PeerView]:
        """All known peers, in GUID order."""
        return self._membership.peers(yielder)

    def strangers(self) -> tuple[Stranger, ...]:
        """The modules that are heard and are not of this mesh."""
        return self._filter.strangers(time.monotonic())

    def notes(self) -> tuple[str, ...]:
        """Problems of the network, as texts for the user."""
        strangers = {host for one in self.strangers() for host, _ in one.identity.endpoints}
        silent = [
            f"seed {host}:{port}: no answer; is `rmpa up` running there, in domain {self._settings.domain} too, "
            "and its UDP port open?"
            for host, port in self._membership.silent_seeds()
            if host not in strangers
        ]
        full = self._filter.strangers_note(time.monotonic())
        return (*sorted(self._warned), *silent, *([full] if full else ()))

    # --- sockets ----------------------------------------------------------------------------------------------

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
        elif not more and self._membership.size >= limits.HEARTBEATS_WAIT_MEMBERS:
            self._defer_heartbeats(sock)
        elif self._heartbeats_tick is not None:
            self._heartbeats_tick = None
            self._listen(sock, multicast=True)
        if self._filter.overrun:
            # A flood of forged packets must not take the core: for a while they stay in the kernel's buffer.
            self.counters.add("beacon.paused")
            self._membership.beacons_lost(time.monotonic())
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
            except (BlockingIOError, InterruptedError):
                return False
            except OSError as error:  # an ICMP error that some earlier packet of ours caused
                _log.debug("< %s", error)
                continue
            packet = self._filter.parse(data, source, now, multicast=multicast, interface=index)
            if packet is not None:
                beacon, old_key = packet
                _log.debug("< %s:%d (interface %d): %s", *source, index, beacon)
                if old_key is None:
                    self._membership.receive(beacon, source, now, multicast=multicast)
                else:
                    self._membership.recognise(beacon, source, old_key)
            elif self._filter.overrun:
                return False
        return True

    # --- interfaces and seeds ---------------------------------------------------------------------------------

    def _look_again(self) -> bool:
        """Act on a change of the interfaces; return whether they could be listed."""
        try:
            everything = self._look()
        except OSError as error:  # no file descriptor is left to ask the kernel
            _log.debug("! interfaces cannot be listed: %s", error)
            return False
        if everything != self._everything:
            self._everything = everything
            self._use_interfaces()
            if self._on_interfaces(everything):
                self._membership.interfaces_changed(time.monotonic(), self._other_addresses())
                self._flush()
        return True

    def _other_addresses(self) -> tuple[IPv4Address, ...]:
        wanted = self._settings.interfaces
        mine = [i for i in self._everything if i.up and (not wanted or i.name in wanted)]
        return network.further_addresses(mine, self._identity.guid.address)

    def _use_interfaces(self) -> None:
        """Choose the usable interfaces, and join the group on them."""
        wanted = self._settings.interfaces
        before, self.interfaces = self.interfaces, network.choose(self._everything, wanted)
        if problem := network.unknown_names(self._everything, wanted):
            self._warn(problem, "no-interface")
        if not self._settings.multicast.enabled:
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
        default = self._settings.discovery_port
        seeds = self._settings.seeds
        self._membership.set_seeds((a, s.port or default) for s in seeds for a in self._seed_hosts.get(s.host, ()))
        self._flush()

    def _warn(self, text: str, code: str) -> None:
        if text not in self._warned:
            self._warned.add(text)
            _log.warning("! %s [%s]", text, code)

    # --- outputs and events -----------------------------------------------------------------------------------

    def _flush(self) -> None:
        """Send the outputs, deliver the events, set the timer. A handler of an event may call this again."""
        if self._flushing:
            return
        self._flushing = True
        try:
            while True:
                outputs, events = self._membership.outputs(), self._membership.events()
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
                    self._on_event(event)
        finally:
            self._flushing = False
            if self._started:
                self._timer.arm()

    def _send(self, beacon: Beacon, address: Address | None, key: int) -> None:
        """Send a beacon, signed in a secured mesh; the arguments as for ``announcing.OutgoingBeacon``."""
        packet = beacon.serialize()
        if self._trust is not None:
            packet = self._trust.sign(packet, time.monotonic(), key)
        if address is None:
            _log.debug("> group: %s", beacon)
            self._sender.multicast(packet, self.interfaces)
        else:
            _log.debug("> %s:%d: %s", *address, beacon)
            self._sender.unicast(packet, address)

    def _timer_due(self, now: float) -> None:
        self._membership.handle_timer(now)
        self._flush()
