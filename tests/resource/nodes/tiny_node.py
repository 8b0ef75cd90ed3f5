"""A ROS node of the standard library alone, for tests: it registers itself, answers ``getPid``, and obeys signals.

Usage: ``tiny_node.py NAME [--refuse] [--deaf] [--child]``; ``--refuse`` ends at once with code 3, ``--deaf`` ignores
SIGINT and SIGTERM, ``--child`` leaves a process of its group behind.
"""

import os
import signal
import subprocess
import sys
from pathlib import Path
from xmlrpc.client import ServerProxy
from xmlrpc.server import SimpleXMLRPCServer

name = sys.argv[1]
print(f"begins: {sys.argv[2:]} in {Path.cwd()} with {os.environ.get('COLOUR', '')}", flush=True)
if "--refuse" in sys.argv:
    print("no device /dev/none", file=sys.stderr)
    sys.exit(3)
if "--deaf" in sys.argv:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
else:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
if "--child" in sys.argv:
    child = subprocess.Popen(["sleep", "1000"])
    print(f"child {child.pid}", flush=True)


def end(*_: object) -> None:
    os._exit(0)


server = SimpleXMLRPCServer(("127.0.0.1", 0), logRequests=False, allow_none=True)
uri = f"http://127.0.0.1:{server.server_address[1]}/"
server.register_function(lambda _caller: [1, "", os.getpid()], "getPid")
server.register_function(lambda *_: [1, "", 0], "publisherUpdate")
server.register_function(lambda *_: [1, "", 0], "paramUpdate")
server.register_function(end, "shutdown")
master = ServerProxy(os.environ["ROS_MASTER_URI"])
master.registerPublisher(name, f"{name}/alive", "std_msgs/String", uri)
try:
    server.serve_forever()
except KeyboardInterrupt:
    print("ends in order", flush=True)
    master.unregisterPublisher(name, f"{name}/alive", uri)
