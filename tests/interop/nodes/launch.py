"""What a master sees of a roslaunch: many nodes that start at once, each with a slave API and connections of its own.

Reads "launch" and "end" lines. Each node asks what rospy and roscpp ask at their start, sets parameters, registers
its logger's services, /rosout, its topics and its subscriptions; at the end it takes all of it back. Only Python.
Options: --count (nodes), --topics (of each). Events: up; launched and ended with the calls made and their seconds.
"""

import argparse
import asyncio
import json
import os
import sys
import time
import urllib.parse
import xmlrpc.client
from typing import Any

OK = xmlrpc.client.dumps(((1, "", 0),), methodresponse=True).encode()
TYPE = "sensor_msgs/PointCloud2"
PARAMETERS = {"rate": 10.0, "frame": "base_link", "gains": [1.0, 0.1, 0.01], "limits": {"linear": 1.2, "turn": 2.5}}
Call = tuple[Any, ...]


def say(event: str, **fields: object) -> None:
    print("@ " + json.dumps({"event": event, **fields}), flush=True)


async def body_of(reader: asyncio.StreamReader) -> bytes:
    head = await reader.readuntil(b"\r\n\r\n")
    lines = head.lower().split(b"\r\n")
    length = next(int(line.split(b":")[1]) for line in lines if line.startswith(b"content-length"))
    return await reader.readexactly(length)


async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Say yes to whatever the master tells."""
    try:
        while True:
            await body_of(reader)
            writer.write(b"HTTP/1.1 200 OK\r\nContent-Type: text/xml\r\nContent-length: %d\r\n\r\n%s" % (len(OK), OK))
            await writer.drain()
    except (OSError, asyncio.IncompleteReadError):
        writer.close()


class Node:
    """One node of the launch."""

    def __init__(self, number: int, nodes: int, topics: int) -> None:
        self.name = f"/launch/node_{number}"
        self.calls = 0
        self._nodes, self._number = nodes, number
        self._topics = range(topics)
        self._server: asyncio.Server | None = None
        self._api = ""

    async def launch(self) -> None:
        """Start."""
        self._server = await asyncio.start_server(answer, "127.0.0.1", 0)
        self._api = f"http://127.0.0.1:{self._server.sockets[0].getsockname()[1]}/"
        before: list[Call] = [("getParam", "/run_id"), ("hasParam", "/use_sim_time"), ("hasParam", "/tcp_keepalive")]
        before += [("setParam", f"{self.name}/{key}", value) for key, value in PARAMETERS.items()]
        before += [("registerPublisher", "/rosout", "rosgraph_msgs/Log", self._api)]
        await self._ask(*before, *self._services("registerService", self._api))
        await self._ask(*(("registerPublisher", topic, TYPE, self._api) for topic in self._own()))
        await self._ask(*(("registerSubscriber", topic, TYPE, self._api) for topic in self._others()))

    async def end(self) -> None:
        """Leave."""
        await self._ask(*(("unregisterSubscriber", topic, self._api) for topic in self._others()))
        await self._ask(*(("unregisterPublisher", topic, self._api) for topic in (*self._own(), "/rosout")))
        await self._ask(*self._services("unregisterService"), ("deleteParam", self.name))
        assert self._server is not None
        self._server.close()

    def _own(self) -> list[str]:
        return [f"{self.name}/some/topic_{topic}" for topic in self._topics]

    def _others(self) -> list[str]:
        return [f"/launch/node_{(self._number + 1) % self._nodes}/some/topic_{topic}" for topic in self._topics][:4]

    def _services(self, method: str, *further: str) -> list[Call]:
        names = [f"{self.name}/{service}" for service in ("get_loggers", "set_logger_level")]
        return [(method, name, f"rosrpc://127.0.0.1:{20_000 + self._number}", *further) for name in names]

    async def _ask(self, *calls: Call) -> None:
        master = urllib.parse.urlsplit(os.environ["ROS_MASTER_URI"])
        reader, writer = await asyncio.open_connection(master.hostname, master.port)
        for method, *parameters in calls:
            body = xmlrpc.client.dumps((self.name, *parameters), str(method)).encode()
            head = "POST /RPC2 HTTP/1.1\r\nHost: master\r\nContent-Type: text/xml\r\n"
            writer.write(f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body)
            (reply,), _ = xmlrpc.client.loads(await body_of(reader))
            if not isinstance(reply, list) or (reply[0] != 1 and method != "getParam"):
                sys.exit(f"the master says {reply!r} to {method}{parameters}")
            self.calls += 1
        writer.close()


async def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--count", type=int, default=50)
    options.add_argument("--topics", type=int, default=10)
    chosen = options.parse_args()
    nodes = [Node(number, chosen.count, chosen.topics) for number in range(chosen.count)]
    say("up")
    while line := await asyncio.to_thread(sys.stdin.readline):
        begin, before = time.monotonic(), sum(node.calls for node in nodes)
        word = line.strip()
        await asyncio.gather(*(node.launch() if word == "launch" else node.end() for node in nodes))
        calls = sum(node.calls for node in nodes) - before
        say("launched" if word == "launch" else "ended", calls=calls, seconds=time.monotonic() - begin)


asyncio.run(main())
