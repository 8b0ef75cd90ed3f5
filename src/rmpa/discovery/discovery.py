"""Runs the membership protocol on UDP sockets, and judges packets before they are parsed.

Runs the membership protocol: UDP sockets, timer, interfaces and seeds.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import random
from collections import OrderedDict
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

from rmpa.core.counters import Counters, RefusalLog, TokenBucket
from rmpa.core.errors import RemoteProtocolError
from rmpa.discovery import limits
from rmpa.discovery import network as sockets
from rmpa.discovery.beacon import (
    RUN_AT,
    Beacon,
    BeaconOtherDomain,
    BeaconOtherVersion,
    PeerConflict,
    SendMulticast,
    Strangers,
    sender_of,
)
from rmpa.discovery.membership import MembershipProtocol
from rmpa.discovery.network import (
    Interface,
    InterfaceWatcher,
    SeedResolver,
    choose,
    further_addresses,
    list_interfaces,
    resolve_ipv4,
    unknown_names,
)
from rmpa.runtime.loop import MachineTimer, SystemClock, yield_to_data
from rmpa.trust import limits as trust_limits
from rmpa.trust.packets import KeyPurpose, Verdict
from rmpa.trust.permissions import TrustReason, not_of_this_mesh

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable
    from ipaddress import IPv4Address

    from rmpa.config.settings import Settings
    from rmpa.core.counters import Clock
    from rmpa.core.identity import Guid, Identity
    from rmpa.discovery.beacon import Address, Event, Output, PeerView, Stranger
    from rmpa.trust.packets import PacketTrust, Verification


# Filters the packets of the discovery sockets: drops repeats, floods and malformed packets, and parses the rest.


_log = logging.getLogger(__name__)

_INTERFACES: Final = 256
_REFUSED: Final = {
    Verdict.UNTAGGED: TrustReason.UNSECURED,
    Verdict.UNKNOWN_KEY: TrustReason.KEY,
    Verdict.FORGED: TrustReason.FOREIGN,
}
"""What is told of the senders of packets that are refused; repeats are only counted."""


@dataclass(frozen=True, slots=True)
class Recognised:
    """A beacon whose sender has only an older group key: nothing in it is proved.

    Args:
        beacon: What it says.
        key: The low 16 bits of the key's number.
    """

    beacon: Beacon
    key: int


class AddressLimit:
    """Allows each address so many packets in one second, and forgets the address that was silent for longest.

    Args:
        rate: Packets a second of one address.
        addresses: How many are remembered.
    """

    def __init__(self, rate: int, addresses: int) -> None:
        self._rate = rate
        self._addresses = addresses
        self._counts: OrderedDict[str, tuple[float, int]] = OrderedDict()

    def take(self, host: str, now: float) -> bool:
        """Count a packet; return whether it is allowed."""
        since, count = self._counts.get(host, (now, 0))
        if now - since >= 1.0:
            since, count = now, 0
        self._counts[host] = (since, count + 1)
        self._counts.move_to_end(host)
        if len(self._counts) > self._addresses:
            self._counts.popitem(last=False)
        return count < self._rate


class PacketFilter:
    """Parses packets; those that are dropped are counted.

    Args:
        domain: This agent's domain id.
        counters: ``beacon.in``, ``beacon.repeated``, ``beacon.flood``, ``beacon.unlinked_limited``,
            ``beacon.other_domain``, ``beacon.version``, ``beacon.malformed``.
        is_verified: Whether a run of a peer has or had a link: beacons of such peers, and echoes of this agent's
            own, are not limited in rate.
        trust: Of a secured mesh: only packets whose trailer is accepted are parsed; ``beacon.untagged``,
            ``beacon.forged`` and so on count the others.
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
        self._unlinked: dict[int, TokenBucket] = {}
        self._unproved = TokenBucket(limits.BEACONS_UNPROVED_PER_SECOND, limits.BEACONS_UNPROVED_BURST)
        self.strangers = Strangers()
        """The modules whose beacons are refused, for the user."""
        self.overrun = False
        """Whether packets without a valid proof come faster than they can be looked at: pause the reading."""
        self._refusals = RefusalLog(_log, counters)
        self._recent: OrderedDict[bytes, None] = OrderedDict()
        self._sources = AddressLimit(limits.BEACONS_PER_SOURCE, limits.BEACON_SOURCES_MAX)
        self._old_key_sources = AddressLimit(trust_limits.OLD_KEY_PACKETS_PER_ADDRESS, trust_limits.OLD_KEYS_MAX)
        self._old_keys = TokenBucket(trust_limits.OLD_KEY_PACKETS_RATE, trust_limits.OLD_KEY_PACKETS_RATE)

    def parse(
        self, data: bytes, source: Address, now: float, *, multicast: bool, interface: int = 0
    ) -> Beacon | Recognised | None:
        """What a packet contains; ``None`` if it is dropped, which is counted and, where it helps, logged.

        Other domains have other ports, so their multicasts are ignored silently. A unicast of another domain is
        logged: its sender was given this address by a user, and waits for an answer.

        Args:
            data: The packet.
            source: The address and port it came from.
            now: Monotonic seconds.
            multicast: Whether it came to the group.
            interface: The index of the interface it came in by: each has a limit of its own.
        """
        host, _ = source
        # First, where there is a proof: packets with the forged source of a member must not count as its flood.
        if self._trust is not None:
            proof = self._verify(self._trust, data, host, now)
            if proof is None or proof.verdict is Verdict.OLD_KEY:
                return self._recognise(data, proof.key) if proof is not None else None
        if not self._sources.take(host, now):
            self._refusals.refuse(
                now, "beacon.flood", host, f"{host} sends too many packets to the discovery port; the rest is ignored"
            )
            return None
        if self._trust is None and not self._is_new(data):
            return None
        return self._read(data, host, now, multicast=multicast, interface=interface)

    def _read(self, data: bytes, host: str, now: float, *, multicast: bool, interface: int) -> Beacon | None:
        """Parse a packet within the limits of its sender."""
        try:
            verified = self._is_verified(*sender_of(data, self._domain))
            if not verified and not self._unlinked_limit(interface).take(now):
                self._counters.add("beacon.unlinked_limited")
                return None
            packet = Beacon.parse(data, self._domain)
        except BeaconOtherDomain as error:
            if multicast:
                self._counters.add("beacon.other_domain")
            else:
                remedy = f"we are of domain {self._domain}: start both with the same --domain (ROS_DOMAIN_ID)"
                self._refusals.refuse(now, "beacon.other_domain", host, f"the peer at {host} {error}, {remedy}")
        except BeaconOtherVersion as error:
            self._refusals.refuse(now, "beacon.version", host, f"the peer at {host} {error}")
        except RemoteProtocolError as error:
            self._refusals.refuse(now, "beacon.malformed", host, f"from {host}: {error}; is another program there?")
        else:
            self._counters.add("beacon.in")
            return packet
        return None

    def _is_new(self, data: bytes) -> bool:
        """Whether a packet did not come before, by another interface."""
        if data in self._recent:
            self._counters.add("beacon.repeated")
            return False
        if len(data) <= limits.BEACON_MAX_BYTES:
            self._recent[data] = None
            if len(self._recent) > limits.BEACON_REPEATS:
                self._recent.popitem(last=False)
        return True

    def _verify(self, trust: PacketTrust, data: bytes, host: str, now: float) -> Verification | None:
        """The proof of a packet that a member of the secured mesh sent just now, or a module that was one.

        Nothing is remembered of other packets, so that forged ones cannot push out what is remembered of real ones.
        """
        if len(data) > limits.BEACON_MAX_BYTES:
            self._counters.add("beacon.malformed")
            return None
        found = trust.verifier.verify(data, KeyPurpose.BEACON, RUN_AT, now, trust.wall())
        if found.verdict is Verdict.ACCEPTED:
            return found
        # One address must not use up what there is for all.
        if found.verdict is Verdict.OLD_KEY and self._old_key_sources.take(host, now) and self._old_keys.take(now):
            self._counters.add("beacon.old_key")
            return found
        self.overrun = not self._unproved.take(now)
        if found.verdict is Verdict.OLD_KEY:
            self._counters.add("beacon.limited")
            return None
        problem = _problem(found)
        beacon = self._stranger(data, now) if problem else None
        if beacon is not None and self.strangers.hear(beacon, problem, now):
            identity = beacon.identity
            at = str(identity.guid.address)  # that of the packet is another one by each interface of a machine
            self._refusals.refuse(now, f"beacon.{found.verdict}", at, f"{identity.name} at {host} is {problem}")
        else:
            self._counters.add(f"beacon.{found.verdict}")
        return None

    def _stranger(self, data: bytes, now: float) -> Beacon | None:
        """The beacon in a refused packet; ``None``: it is none of this domain, or too many came."""
        if self.strangers.may_read(now):
            with contextlib.suppress(RemoteProtocolError):
                return Beacon.parse(data, self._domain)
        return None

    def _recognise(self, data: bytes, key: int) -> Recognised | None:
        """The beacon of a module with an older group key."""
        try:
            return Recognised(Beacon.parse(data, self._domain), key)
        except RemoteProtocolError:
            self._counters.add("beacon.malformed")
            return None

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
