"""Says when a graph holds what was expected: asks its master again and again. Needs nothing but Python.

Options: --topics and --services: how many below /crowd, --every: seconds between two looks. Events: up; topics,
services: each with ``at``, the monotonic time in seconds when all of them were seen, and their count.
"""

from __future__ import annotations

import argparse
import os
import time
import xmlrpc.client
from typing import Any

from node import say


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--topics", type=int, required=True)
    options.add_argument("--services", type=int, default=0)
    options.add_argument("--every", type=float, default=0.02)
    wanted = options.parse_args()
    left = {"topics": (0, wanted.topics), "services": (2, wanted.services)}
    say("up")
    while left:
        time.sleep(wanted.every)
        try:
            answer: Any = xmlrpc.client.ServerProxy(os.environ["ROS_MASTER_URI"]).getSystemState("/mirrored")
        except OSError:
            continue  # not there yet
        now = time.monotonic()
        for kind, (place, count) in list(left.items()):
            found = sum(entry[0].startswith("/crowd") for entry in answer[2][place])
            if found >= count:
                say(kind, at=now, count=found)
                del left[kind]


if __name__ == "__main__":
    main()
