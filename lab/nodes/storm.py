"""XML-RPC calls to a master as tools and starting nodes make them, one after another on a schedule: no ROS needed.

Reads "fill PORT" and "PORT RATE SECONDS" lines. ``fill`` gives the master at 127.0.0.1:PORT the graph and parameters
of a launch of fifty nodes, so that its answers have a real size. Each call has a connection of its own, as those of
command line tools have. Answers to what the master tells the nodes are given, too.
Events: up; filled; stormed with the calls made, those that failed, and the sorted milliseconds that they took.
"""

import itertools
import re
import socket
import sys
import threading
import time
import xmlrpc.client
from typing import Any
from xmlrpc.server import SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

from node import say

NODES, TOPICS = 50, 3
MIX = (
    "getPublishedTopics",
    "getParam",
    "setParam",
    "registerSubscriber",
    "lookupNode",
    "getSystemState",
    "getParam",
    "setParam",
    "unregisterSubscriber",
    "lookupNode",
)
"""Ten calls, over and over; a subscriber that registers leaves five calls later."""
_TIMEOUT = 10.0
_GOOD = re.compile(rb"<array><data>\s*<value><(int|i4)>1</")


class Nodes:
    """The slave API of all fifty at one port: whatever the master says is fine."""

    def __init__(self) -> None:
        handler = type("Handler", (SimpleXMLRPCRequestHandler,), {"protocol_version": "HTTP/1.1"})
        self._server = SimpleXMLRPCServer(("127.0.0.1", 0), requestHandler=handler, logRequests=False)
        self._server.register_instance(self)
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        self.api = f"http://127.0.0.1:{self._server.server_address[1]}/"

    def _dispatch(self, _method: str, _params: tuple[object, ...]) -> list[object]:
        return [1, "", 0]


def arguments(method: str, number: int, api: str) -> tuple[str | float, ...]:
    """Of the call that is the ``number``-th of all."""
    node = f"/storm/node{number // len(MIX) % NODES}"
    topic = f"/storm/topic{number // len(MIX) % (NODES * TOPICS)}"
    values: dict[str, tuple[str | float, ...]] = {
        "getPublishedTopics": (node, ""),
        "getSystemState": (node,),
        "getParam": (node, f"{node}/gain"),
        "setParam": (node, f"{node}/gain", number / 7),
        "lookupNode": (node, node),
        "registerSubscriber": (node + "_late", topic, "std_msgs/String", api),
        "unregisterSubscriber": (node + "_late", topic, api),
    }
    return values[method]


def call(port: int, method: str, params: tuple[Any, ...]) -> bool:
    body = xmlrpc.client.dumps(params, method).encode()
    head = f"POST /RPC2 HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nConnection: close\r\nContent-Type: text/xml\r\n"
    answer = b""
    try:
        with socket.create_connection(("127.0.0.1", port), _TIMEOUT) as sock:
            sock.sendall(f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body)
            while chunk := sock.recv(1 << 16):
                answer += chunk
    except OSError:
        return False
    return _GOOD.search(answer[:1000]) is not None


def fill(port: int, api: str) -> None:
    failed = 0
    for number in range(NODES):
        node = f"/storm/node{number}"
        for turn in range(TOPICS):
            params = (node, f"/storm/topic{(number + turn) % (NODES * TOPICS)}", "std_msgs/String", api)
            failed += not call(port, "registerSubscriber", params)
        failed += not call(port, "setParam", (node, node, {"gain": 1.0, "frame": "base", "limits": [0.1, 0.2, 0.3]}))
    say("filled", failed=failed)


def storm(port: int, rate: float, seconds: float, api: str) -> None:
    took, failed = [], 0
    start = time.perf_counter()
    for number, method in zip(range(int(rate * seconds)), itertools.cycle(MIX)):
        time.sleep(max(0.0, start + number / rate - time.perf_counter()))
        begun = time.perf_counter()
        failed += not call(port, method, arguments(method, number, api))
        took.append(round(1000 * (time.perf_counter() - begun), 3))
    say("stormed", calls=len(took), failed=failed, seconds=time.perf_counter() - start, took=sorted(took))


def main() -> None:
    api = Nodes().api
    say("up")
    for line in sys.stdin:
        words = line.split()
        if words[0] == "fill":
            fill(int(words[1]), api)
        else:
            storm(int(words[0]), float(words[1]), float(words[2]), api)


if __name__ == "__main__":
    main()
