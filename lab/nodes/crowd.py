"""A large graph at little cost: registers publishers that never send, as many as it is told to.

Reads lines with a number: registers publishers until there are so many, ``--per-node`` on each node, and for each
node ``--services`` services. All nodes share one slave API and one TCPROS server, which answers a subscriber's header
and keeps quiet. Needs nothing but Python.
Options: --per-node, --services. Events: up; registered with the count, and the ns at which
the last one was.
"""

from __future__ import annotations

import argparse
import os
import socketserver
import struct
import sys
import threading
import time
import xmlrpc.client
from xmlrpc.server import SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

from node import say

TYPE = "std_msgs/UInt8MultiArray"
MD5 = "82373f1612381bb6ee473b5cd6f5d89c"
_HOST = "127.0.0.1"
_LOOK_FOR_THE_END = 30.0
"""Seconds; the server's own half second would wake this process while others are measured."""


class Keeping(SimpleXMLRPCRequestHandler):
    """Keeps connections open, as rospy and roscpp do."""

    protocol_version = "HTTP/1.1"


class CrowdSlaveApi(socketserver.ThreadingMixIn, SimpleXMLRPCServer):
    """What a master and subscribers may ask of a node."""

    daemon_threads = True

    def __init__(self, tcpros_port: int) -> None:
        super().__init__((_HOST, 0), Keeping, logRequests=False, allow_none=True)
        self.register_function(lambda _caller: [1, "", os.getpid()], "getPid")
        self.register_function(lambda _caller, _topic, _publishers: [1, "", 0], "publisherUpdate")
        self.register_function(
            lambda _caller, _topic, _protocols: [1, "ready", ["TCPROS", _HOST, tcpros_port]], "requestTopic"
        )


class Silent(socketserver.BaseRequestHandler):
    """Answers the header of a subscriber, and sends nothing until that goes."""

    def handle(self) -> None:
        (length,) = struct.unpack("<I", self.request.recv(4))
        self.request.recv(length)
        fields = b""
        for field in (f"type={TYPE}", f"md5sum={MD5}", "callerid=/crowd", "latching=0", "message_definition=*"):
            fields += struct.pack("<I", len(field)) + field.encode()
        self.request.sendall(struct.pack("<I", len(fields)) + fields)
        while self.request.recv(4096):
            pass


class Publications(socketserver.ThreadingTCPServer):
    """The TCPROS server."""

    daemon_threads = True
    allow_reuse_address = True


def serve(server: socketserver.BaseServer) -> None:
    threading.Thread(target=server.serve_forever, args=(_LOOK_FOR_THE_END,), daemon=True).start()


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--per-node", type=int, default=20)
    options.add_argument("--services", type=int, default=0)
    given = options.parse_args()
    per_node = given.per_node
    publications = Publications((_HOST, 0), Silent)
    slave = CrowdSlaveApi(publications.server_address[1])
    serve(publications)
    serve(slave)
    api = f"http://{_HOST}:{slave.server_address[1]}/"
    master = xmlrpc.client.ServerProxy(os.environ["ROS_MASTER_URI"])
    say("up")
    registered = 0
    for line in sys.stdin:
        while registered < int(line):
            node, topic = f"/crowd{registered // per_node}", f"/crowd/topic{registered}"
            answer = master.registerPublisher(node, topic, TYPE, api)
            if not isinstance(answer, list) or answer[0] != 1:
                sys.exit(f"the master refused {topic}: {answer!r}")
            if not registered % per_node:
                for number in range(given.services):
                    service, port = f"{node}/service{number}", publications.server_address[1]
                    master.registerService(node, service, f"rosrpc://{_HOST}:{port}", api)
            registered += 1
        say("registered", count=registered, at_ns=time.monotonic_ns())


if __name__ == "__main__":
    main()
