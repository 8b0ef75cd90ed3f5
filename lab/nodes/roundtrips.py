"""What every Python ping of a messaging library does alike: lines, files and events as of ``floor.cpp``."""

from __future__ import annotations

import array
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from node import say

if TYPE_CHECKING:
    from collections.abc import Callable

# Seconds after which a round trip is lost.
TIMEOUT = 1.0


def measure(trips_of: Callable[[int], Callable[[], bool]], first: int = 64) -> None:
    """Answer "SIZE COUNT FILE" lines until there are none.

    Args:
        trips_of: Makes ready for messages of a size; what it returns sends one, waits for its return, and says
            whether that came within ``TIMEOUT``.
        first: The size of the message that must come back once before the path is ready.
    """
    trip = trips_of(first)
    while not trip():
        pass
    say("ready")
    for line in sys.stdin:
        size, count, path = line.split()
        trip = trips_of(int(size))
        samples = array.array("Q")
        for _ in range(int(count)):
            start = time.perf_counter_ns()
            if trip():
                samples.append(time.perf_counter_ns() - start)
        Path(path).write_bytes(samples.tobytes())
        say("round", lost=int(count) - len(samples))
