"""A Smart Resource with a periodic task, for ``rmpa run``; lines, files and events as of ``timed_loop.py``.

The clock is the monotonic one, which the task's schedule follows. RMPA_BENCH_RATE is the rate, Hz.
"""

import array
import json
import os
import sys
import threading
import time
from pathlib import Path

from rmpa.resource import Resource
from rmpa.resource.run.schedule import TaskFigures

resource = Resource("rated", role="sensing", physical=False)
output = resource.output("/rated/resource", "std_msgs/UInt8MultiArray")
_DATA = bytes(64)


class RunNotes:
    """When each run was due, and when it began."""

    def __init__(self) -> None:
        self.due = 0.0
        self.runs: list[tuple[int, float]] = []
        self.wanted = 0
        self.full = threading.Event()


notes = RunNotes()


def say(event: str) -> None:
    print("@ " + json.dumps({"event": event}), flush=True)


@resource.profile(offers={"rate": "100 Hz"})
def only() -> None:
    """Nothing to set."""


@resource.task(rate=float(os.environ.get("RMPA_BENCH_RATE", "100")))
def work() -> None:
    began = time.monotonic_ns()
    if notes.wanted:
        notes.runs.append((began, notes.due))
        if len(notes.runs) >= notes.wanted:
            notes.wanted = 0
            notes.full.set()
    output.publish(data=_DATA)


_begun = TaskFigures.begun


def _note_due(figures: TaskFigures, due: float, now: float) -> None:
    notes.due = due
    _begun(figures, due, now)


setattr(TaskFigures, "begun", _note_due)  # noqa: B010 - the task itself is not told when it was due


def listen() -> None:
    """Serve what the measurement asks for."""
    for line in sys.stdin:
        count, path = line.split()
        notes.full.clear()
        notes.runs = []
        notes.wanted = int(count)
        notes.full.wait()
        pairs = array.array("Q")
        for began, due in notes.runs:
            pairs.append(round(1e9 * due))
            pairs.append(began)
        Path(path).write_bytes(pairs.tobytes())
        say("done")


threading.Thread(target=listen, daemon=True).start()
