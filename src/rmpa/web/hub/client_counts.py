"""``/client_count`` and ``/connected_clients``, as rosbridge_suite publishes them."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RmpaError
from rmpa.web.values.codec import codec_for

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.web.hub.clients import Key
    from rmpa.web.hub.publishers import Publishers
    from rmpa.web.hub.types import TypeLibrary

_log = logging.getLogger(__name__)
COUNT: Final = "/client_count"
CLIENTS: Final = "/connected_clients"
_TYPES: Final = {COUNT: "std_msgs/Int32", CLIENTS: "rosbridge_msgs/ConnectedClients"}
_NANO: Final = 1_000_000_000


@dataclass(frozen=True, slots=True)
class _Connected:
    address: str
    since_ns: int


class ClientCounts:
    """Publishes the number and the list of rosbridge clients, latched, from the first client on.

    Args:
        publishers: The hub's.
        types: Finds the two types.
        key: For the publishers.
        now_ns: The wall clock, in nanoseconds.
    """

    def __init__(self, publishers: Publishers, types: TypeLibrary, key: Key, now_ns: Callable[[], int]) -> None:
        self._now_ns = now_ns
        self._publishers = publishers
        self._types = types
        self._key = key
        self._clients: dict[int, _Connected] = {}
        self._advertised = False

    def add(self, number: int, address: str) -> None:
        """A client is there."""
        self._clients[number] = _Connected(address, self._now_ns())
        self._publish()

    def remove(self, number: int) -> None:
        """A client has gone."""
        if self._clients.pop(number, None) is not None:
            self._publish()

    def _publish(self) -> None:
        if not self._advertised:
            self._advertised = True
            for topic, type_ in _TYPES.items():
                try:
                    self._publishers.advertise(self._key, topic, type_, self._refused, latch=True)
                except RmpaError as error:  # a client publishes that topic with another type
                    self._refused(error)
        clients = [
            {
                "ip_address": each.address,
                "connection_time": {"secs": each.since_ns // _NANO, "nsecs": each.since_ns % _NANO},
            }
            for each in self._clients.values()
        ]
        for topic, values in ((COUNT, {"data": len(clients)}), (CLIENTS, {"clients": clients})):
            codec = codec_for(self._types.message(_TYPES[topic]))
            self._publishers.publish(topic, codec.write(values, 0).payload)

    @staticmethod
    def _refused(error: RmpaError) -> None:
        _log.warning("! %s", error)
