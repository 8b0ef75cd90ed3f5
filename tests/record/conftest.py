"""What the tests of recordings share: sources, and files made of few words."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Iterable, Iterator
from pathlib import Path

import msgspec
import pytest

from rmpa.record.format import CLOCK, TIME, ClockRecord, ModuleRecord, Recorded, RecordedSource, SegmentWriter
from rmpa.record.merge import Timeline
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.types.messages import MessageType

TEXT = MessageType("std_msgs/String")
SECOND = 1_000_000_000
# A time of the recordings of tests, Unix nanoseconds.
START = 1_795_000_000 * SECOND
# Seconds from the start, and what was said.
Said = Iterable[tuple[float, str]]


def source(topic: str, node: str = "/talker", *, latching: bool = False, module: str = "") -> RecordedSource:
    """A publisher of texts."""
    return RecordedSource(topic, TEXT.name, TEXT.md5sum, TEXT.definition, node, latching, module)


def text(data: str) -> bytes:
    """A ``std_msgs/String`` as bytes."""
    return TEXT.serialize(TEXT.given(None, {"data": data}))


class HandClock:
    """A machine's monotonic and wall clock, both set by a test."""

    def __init__(self) -> None:
        self.seconds, self.epoch = 1000.0, START - 1000 * SECOND

    def now(self) -> float:
        return self.seconds

    def wall(self) -> int:
        return round(self.seconds * SECOND) + self.epoch


def read_any(path: Path) -> Iterator[Recorded]:
    """The messages of a recording, in order of their times."""
    return Timeline([path]).messages()


@pytest.fixture
async def core() -> AsyncIterator[RosCore]:
    """A module's core."""
    one = RosCore(port=0)
    await one.start()
    yield one
    await one.close()


Record = Callable[..., Path]


@pytest.fixture
def recording(tmp_path: Path) -> Record:
    """Writes a file of one module: what was said on each topic, and what it knew of others' clocks at a time.

    ``epoch`` is its wall clock less the monotonic one, seconds from the start.
    """

    def write(
        module: str,
        said: dict[RecordedSource, Said],
        clocks: dict[str, tuple[float, float | None]] | None = None,
        name: str = "00000001.mcap",
        at: float | None = None,
        epoch: float | None = None,
    ) -> Path:
        folder = tmp_path / module
        folder.mkdir(exist_ok=True)
        path = folder / name
        with path.open("wb") as file:
            writer = SegmentWriter(file, ModuleRecord(name=module))
            lines = sorted((at, one, data) for one, each in said.items() for at, data in each)
            if clocks:
                when = START + round((lines[0][0] if at is None else at) * SECOND)
                known = {peer: ClockRecord(when, ahead, error) for peer, (ahead, error) in clocks.items()}
                writer.metadata(CLOCK, {peer: msgspec.json.encode(one).decode() for peer, one in known.items()})
            if epoch is not None:
                writer.metadata(TIME, {"boot": "1", "epoch": str(START + round(epoch * SECOND))})
            for at, one, data in lines:
                when = START + round(at * SECOND)
                writer.write(one, when, when, text(data))
            writer.finish()
        return path

    return write
