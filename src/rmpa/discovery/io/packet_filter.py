"""Filters the packets of the discovery sockets: drops repeats, floods and malformed packets, and parses the rest."""

from __future__ import annotations

import contextlib
import logging
from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.core.counters import RefusalLog, TokenBucket
from rmpa.core.errors import RemoteProtocolError
from rmpa.discovery import limits
from rmpa.discovery.beacon import RUN_AT, Beacon, BeaconOtherDomain, BeaconOtherVersion, sender_of
from rmpa.discovery.strangers import Strangers
from rmpa.trust import limits as trust_limits
from rmpa.trust.certificates import TrustReason, not_of_this_mesh
from rmpa.trust.packets import KeyPurpose, Verdict

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.core.counters import Counters
    from rmpa.core.identity import Guid
    from rmpa.discovery.beacon import Address
    from rmpa.trust.packets import PacketTrust, Verification

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
