"""Rounds of measured messages through the nodes of ``nodes/``: start one, wait for its end, read what came.

::

    source, sink = robot.node("joystick", "source", "roscpp"), robot.node("pc", "sink", "roscpp", topics="/cmd")
    flow.wait_connected(source)
    flow.wait_flowing([source], sink, ["/cmd"], stage.scratch)
    began = flow.begin(source, stage.scratch, size=64, rate=10, count=100)
    sent = flow.sent(began)
    came = flow.noted(sink, ["/cmd"], stage.scratch, began.number)

All hosts share one clock, so times of one node may be held against those of another.
"""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
import pandas as pd

from lab.bed.processes import DEADLINE, BedError, Deadline, Process

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


# Bytes at the least of a measured message.
HEAD: Final = 16
# Seconds without an arrival after which a round is over, unless the caller says otherwise.
SETTLE: Final = 0.3
_NOTES: Final = ("topic", "sequence", "due_ns", "came_ns")
_NOTED: Final = 30.0
# Seconds beyond its plan that a source may take until it said ``sent``.
_SLACK: Final = 30.0
# Rate and count of the rounds that only show that messages flow.
_PROBE: Final = (100.0, 10)
_rounds = itertools.count(1)
_files = itertools.count(1)


@dataclass(frozen=True, slots=True)
class Round:
    """One that was begun.

    Args:
        number: In each of its messages, and no other round's in this process.
        source: The node that sends.
        file: Where it writes how late it was.
        seconds: How long it takes.
        mark: The source's events before it.
    """

    number: int
    source: Process
    file: Path
    seconds: float
    mark: int


def begin(source: Process, scratch: Path, *, size: int, rate: float, count: int) -> Round:
    """Let a source send ``count`` messages of ``size`` bytes of data at ``rate`` Hz; it goes on by itself."""
    number = next(_rounds)
    file = scratch / f"sent-{number}"
    mark = source.mark_events()
    source.tell(f"{number} {max(size, HEAD)} {rate} {count} {file}")
    return Round(number, source, file, count / rate, mark)


def sent(begun: Round) -> pd.DataFrame:
    """Wait until all of a round is sent; return how late each message left: ``sequence``, ``late_ns``.

    Raises:
        Deadline: The source has not sent all in time, or has ended.
    """
    begun.source.wait_event(
        "sent", begun.seconds + _SLACK, where=lambda event: event["round"] == begun.number, since=begun.mark
    )
    late = np.fromfile(begun.file, dtype="int64")
    begun.file.unlink()
    return pd.DataFrame({"sequence": np.arange(len(late)), "late_ns": late})


def noted(
    sink: Process, topics: Sequence[str], scratch: Path, number: int = 0, *, settle: float = SETTLE
) -> pd.DataFrame:
    """Wait until nothing more comes; return what came of a round, in the order of arrival.

    Args:
        sink: Forgets all that it noted.
        topics: As it was given them.
        scratch: For its file.
        number: The round's; 0 for what came of all.
        settle: Seconds without an arrival that end it; 10 s are the most that it waits.

    Returns:
        ``topic``, ``sequence``, ``due_ns``, ``came_ns``; the times are of CLOCK_MONOTONIC.

    Raises:
        Deadline: The sink has ended.
        BedError: It noted a topic that is not among ``topics``.
    """
    file = scratch / f"came-{next(_files)}"
    mark = sink.mark_events()
    sink.tell(f"{number} {file} {settle}")
    sink.wait_event("noted", _NOTED, since=mark)
    came = pd.DataFrame(np.fromfile(file, dtype="int64").reshape(-1, 4), columns=[*_NOTES])
    file.unlink()
    if (came["topic"] >= len(topics)).any():
        raise BedError(f"{sink.name} has more topics than {', '.join(topics)}")
    return came.assign(topic=came["topic"].map(dict(enumerate(topics))).astype("str"))


def wait_connected(source: Process, subscribers: int = 1, timeout: float = DEADLINE) -> None:
    """Wait until a source (or velocity) has so many subscribers at the least; through RMPA, an agent is one.

    Raises:
        Deadline: It had not in time.
    """
    source.wait_event("connected", timeout, where=lambda event: int(str(event["subscribers"])) >= subscribers)


def wait_flowing(
    source: Process,
    sink: Process,
    topics: Sequence[str],
    scratch: Path,
    *,
    size: int = 64,
    least: int = 0,
    timeout: float = DEADLINE,
) -> None:
    """Send short rounds until messages of a whole one come on each topic; nothing of them is left at the sink.

    Args:
        source: Sends on the first of the topics, or on one that leads to all.
        sink: Where they must come.
        topics: As the sink was given them.
        scratch: For files.
        size: Bytes of each message.
        least: How many of a round are enough, where something on the way leaves out most (a polled velocity node).
        timeout: Seconds to try.

    Raises:
        Deadline: Some did not come; the text says on which topic.
    """
    deadline = time.monotonic() + timeout
    rate, count = _PROBE
    while True:
        begun = begin(source, scratch, size=size, rate=rate, count=count)
        sent(begun)
        came = noted(sink, topics, scratch, begun.number, settle=0.1)["topic"].tolist()
        missing = [topic for topic in topics if came.count(topic) < (least or count)]
        if not missing:
            return
        if time.monotonic() > deadline:
            raise Deadline(f"not all of {source.name} came to {sink.name} on {', '.join(missing)} in {timeout} s")
