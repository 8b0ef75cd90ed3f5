"""The answers of other nodes to ``getBusInfo``."""

from __future__ import annotations

from rmpa.core.errors import RemoteProtocolError
from rmpa.ros.wire.slave_api import read_bus_info
from rmpa.ros.wire.xmlrpc import RosFault, parse_response, serialize_response

_INFO = "TCPROS connection on port 34738 to [127.0.0.1:52309 on socket 13]"
SEEDS: list[bytes] = [
    serialize_response([1, "", [[1, "http://127.0.0.1:36171/", "i", "TCPROS", "/chatter", True, _INFO]]]),
    serialize_response([1, "bus info", [[0, "/echo", "o", "TCPROS", "/chatter", True, f"Closed {_INFO}"]]]),
    _INFO.encode(),
]


def fuzz(data: bytes) -> None:
    """Read a response, and as the text about a connection: what is read is within its bounds."""
    try:
        answer = parse_response(data)
    except (RemoteProtocolError, RosFault):
        answer = [[1, "/n", "o", "TCPROS", "/t", True, data.decode("latin-1")]]
    for link in read_bus_info(answer):
        ports = (link.local_port, link.remote[1] if link.remote is not None else None)
        assert all(port is None or 0 < port <= 65535 for port in ports)
