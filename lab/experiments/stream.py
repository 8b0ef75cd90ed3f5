"""One stream from the joystick to the pc, measured in steps: of rates, of sizes."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, cast

import pandas as pd

from lab.experiments import flow
from lab.experiments.contenders import nodelay_of, relays_of, system_of, transport_of
from lab.experiments.model import Cell, Measured, Value
from lab.frames import counting_from

if TYPE_CHECKING:
    from collections.abc import Iterator

    from lab.bed.plan import Client
    from lab.bed.processes import Process
    from lab.bed.stage import Stage

HOSTS: Final = ("joystick", "pc")
TOPIC: Final = "/cmd"
# Seconds at the beginning of each step whose messages are not counted: caches and the processor's clock come up.
LEAD: Final = 0.1
# Seconds without an arrival after which a step is over: beyond the delayed acknowledgement's 40 ms, on any link.
SETTLE: Final = 0.2
QUEUE: Final = 1000


class SteppedStream:
    """A source and a sink that are connected, and what came of their steps.

    Args:
        stage: Where files go.
        source: Sends.
        sink: Receives.
        topic: What it subscribes to.
        step: What differs from step to step; the first column of both tables.
    """

    def __init__(self, stage: Stage, source: Process, sink: Process, topic: str, step: str) -> None:
        self._stage, self._source, self._sink, self._topic, self._step = stage, source, sink, topic, step
        self._came: list[pd.DataFrame] = []
        self._sent: list[pd.DataFrame] = []

    def run(self, step: Value, *, size: int, rate: float, count: int) -> None:
        """Send one step; keep its last ``count`` messages."""
        lead = max(2, round(rate * LEAD))
        begun = flow.begin(self._source, self._stage.scratch, size=size, rate=rate, count=lead + count)
        sent = counting_from(flow.sent(begun), lead)
        came = counting_from(
            flow.noted(self._sink, [self._topic], self._stage.scratch, begun.number, settle=SETTLE), lead
        )
        came = came.drop(columns="topic")
        for table, steps in ((sent, self._sent), (came, self._came)):
            table.insert(0, self._step, step)
            steps.append(table)

    def measured(self) -> Measured:
        """All steps: tables ``arrivals`` and ``sent``."""
        came, sent = (pd.concat(steps, ignore_index=True) for steps in (self._came, self._sent))
        return Measured({"arrivals": came, "sent": sent}, {"sent": len(sent), "came": len(came)})


@contextmanager
def stream(cell: Cell, stage: Stage, step: str, *, link: str | None = None) -> Iterator[SteppedStream]:
    """Set up a cell's system with a source and a sink; messages flow when it is given out."""
    client, nodelay = cast("Client", cell.settings["client"]), nodelay_of(cell)
    with stage.system(system_of(cell), HOSTS, link=link, way=transport_of(cell)) as system:
        end = TOPIC
        for host in HOSTS[: relays_of(cell)]:
            begin, end = end, f"{end}_{host}"
            system.node(host, "velocity", "roscpp", cmd=begin, vel=end, mode="event", queue=QUEUE, nodelay=nodelay)
        sink = system.node("pc", "sink", client, topics=end, queue=QUEUE, nodelay=nodelay)
        source = system.node("joystick", "source", client, topic=TOPIC, queue=QUEUE)
        flow.wait_connected(source)
        system.require_transport([(source, sink)])
        flow.wait_flowing(source, sink, [end], stage.scratch)
        yield SteppedStream(stage, source, sink, end, step)
        system.require_transport([(source, sink)])  # to the end
