"""What stands between the sockets and the parser: repeats, floods and malformed packets end here."""

from __future__ import annotations

import logging
from collections import OrderedDict
from typing import TYPE_CHECKING

from rmpa.core import limits
from rmpa.core.counters import RefusalLog
from rmpa.core.errors import RemoteProtocolError
from rmpa.discovery.beacon import Beacon, BeaconOtherDomain, BeaconOtherVersion

if TYPE_CHECKING:
    from rmpa.core.counters import Counters
    from rmpa.discovery.events import Address

_log = logging.getLogger(__name__)


class Intake:
    """Turns packets into beacons, or into counts.

    Args:
        domain: Ours.
        counters: ``beacon.in``, ``beacon.repeated``, ``beacon.flood``, ``beacon.other_domain``,
            ``beacon.version``, ``beacon.malformed``.
    """

    def __init__(self, domain: int, counters: Counters) -> None:
        self._domain = domain
        self._counters = counters
        self._refusals = RefusalLog(_log, counters)
        self._recent: OrderedDict[bytes, None] = OrderedDict()
        self._sources: OrderedDict[str, tuple[float, int]] = OrderedDict()

    def take(self, data: bytes, source: Address, now: float, *, multicast: bool) -> Beacon | None:
        """The beacon in a packet; ``None`` if there is none, which is counted and, where it helps, logged.

        Other domains have ports of their own, and are none of our business. But one that speaks to us alone was
        given our address, and waits for an answer.
        """
        host, _ = source
        if self._floods(host, now):
            self._refusals.refuse(
                now, "beacon.flood", host, f"{host} sends too many packets to the discovery port; the rest is ignored"
            )
            return None
        if data in self._recent:
            self._counters.add("beacon.repeated")
            return None
        if len(data) <= limits.BEACON_MAX_BYTES:
            self._recent[data] = None
            if len(self._recent) > limits.BEACON_REPEATS:
                self._recent.popitem(last=False)
        try:
            beacon = Beacon.parse(data, self._domain)
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
            return beacon
        return None

    def _floods(self, host: str, now: float) -> bool:
        since, count = self._sources.get(host, (now, 0))
        if now - since >= 1.0:
            since, count = now, 0
        self._sources[host] = (since, count + 1)
        self._sources.move_to_end(host)
        if len(self._sources) > limits.BEACON_SOURCES_MAX:
            self._sources.popitem(last=False)
        return count >= limits.BEACONS_PER_SOURCE
