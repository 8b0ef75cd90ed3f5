"""What ``nodes/recorder`` noted: each message, when it was sent and when it came (a lab's hosts have one clock)."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

from lab.bed.processes import DEADLINE, Process, eventually

ROW: Final = struct.Struct("<IIQQII")
_numbers = itertools.count(1)


class Came(NamedTuple):
    """One message that came.

    Args:
        source: Its sender's number.
        sequence: Its number, from 1.
        sent_ns: When its sender made it.
        came_ns: When it reached the callback.
        size: Bytes of payload.
        bad: Whether its bytes are not those that were sent.
    """

    source: int
    sequence: int
    sent_ns: int
    came_ns: int
    size: int
    bad: int

    @property
    def age(self) -> float:
        """Seconds from its sender to the callback."""
        return (self.came_ns - self.sent_ns) / 1e9


def recorded(recorder: Process, folder: Path) -> list[Came]:
    """What a recorder has noted since it was last asked; it forgets it then."""
    path = folder / f"recording-{next(_numbers)}"
    since = recorder.mark_events()
    recorder.tell(str(path))
    recorder.wait_event("noted", since=since)
    return [Came._make(row) for row in ROW.iter_unpack(path.read_bytes())]


def wait_last(recorder: Process, sequence: int, timeout: float = DEADLINE) -> None:
    """Wait until a recorder, or a listener, has reported a message of this number or a later one."""

    def there() -> bool:
        reports = recorder.events("report")
        return bool(reports) and int(str(reports[-1]["last"])) >= sequence

    eventually(there, timeout, what=f"message {sequence} at {recorder.name}")


def connected(teller: Process, heard: list[Process]) -> int:
    """Send one message after the other until each recorder has one; return how many that were."""

    def all_heard() -> bool:
        since = teller.mark_events()
        teller.tell("64 1 0")
        sent.append(int(str(teller.wait_event("told", since=since)["sent"])))
        return all(listener.events("report") for listener in heard)

    sent: list[int] = []
    eventually(all_heard, what="the first message at every recorder", every=0.2)
    for listener in heard:
        wait_last(listener, sent[-1])
    return sent[-1]


def in_order(rows: Sequence[Came], count: int, source: int = 1, *, after: int = 0) -> None:
    """Fail unless these are all messages of a source behind ``after`` up to ``count``, in order, each byte right."""
    mine = [row for row in rows if row.source == source]
    assert not any(row.bad for row in rows)
    sequences = [row.sequence for row in mine]
    if sequences != list(range(after + 1, count + 1)):
        jumps = [(one, other) for one, other in itertools.pairwise([after, *sequences]) if other != one + 1]
        raise AssertionError(f"{len(sequences)} messages, the last {sequences[-1:]}; jumps: {jumps[:20]}")
