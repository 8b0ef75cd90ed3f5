"""The answers of other nodes to ``getBusInfo`` and ``getBusStats``."""

from __future__ import annotations

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.sizes import UINT32_MAX
from rmpa.ros.wire.bus import read_bus_info, read_bus_stats
from rmpa.ros.wire.xmlrpc import RosFault, parse_response, serialize_response

_INFO = "TCPROS connection on port 34738 to [127.0.0.1:52309 on socket 13]"
SEEDS: list[bytes] = [
    serialize_response([1, "", [[1, "http://127.0.0.1:36171/", "i", "TCPROS", "/chatter", True, _INFO]]]),
    serialize_response([1, "bus info", [[0, "/echo", "o", "TCPROS", "/chatter", True, f"Closed {_INFO}"]]]),
    serialize_response([1, "", [[["/a", 8, [[1, 1261, 0, True]]]], [["/b", [[2, 2454, 10, -1, True]]]], []]]),
    serialize_response([[["/a", [[1, 800, 800, 10, 0]]]], [["/b", [[2, -1894965496, 10, 0, 0]]]]]),
    _INFO.encode(),
]


def fuzz(data: bytes) -> None:
    """Read a response as both answers, and as the text about a connection: what is read is within its bounds."""
    try:
        answer = parse_response(data)
    except (RemoteProtocolError, RosFault):
        answer = [[1, "/n", "o", "TCPROS", "/t", True, data.decode("latin-1")]]
    for link in read_bus_info(answer):
        ports = (link.local_port, link.remote[1] if link.remote is not None else None)
        assert all(port is None or 0 < port <= 65535 for port in ports)
    for traffic in read_bus_stats(answer):
        assert 0 <= traffic.bytes <= UINT32_MAX
        assert traffic.messages is None or 0 <= traffic.messages <= UINT32_MAX
        assert traffic.dropped is None or traffic.dropped >= 0
