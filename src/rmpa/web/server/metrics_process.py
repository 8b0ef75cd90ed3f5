"""The text of ``/metrics`` of a large graph, made in a process of its own: ``python -m`` this module.

Thousands of topics take some 0.5 s. A thread of the server would share its interpreter lock with all live clients,
whose messages then wait for it again and again. The process costs its start, and runs with less priority than them.
"""

from __future__ import annotations

import asyncio
import os
import pickle
import sys
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.observe.snapshot import Snapshot
from rmpa.web import limits
from rmpa.web.metrics import exposition
from rmpa.web.server.figures import web_metrics

if TYPE_CHECKING:
    from rmpa.web.server.figures import Figures

_NICE: Final = 5


async def make_metrics(snapshot: Snapshot | None, accept: str, figures: Figures) -> tuple[bytes, str]:
    """The body of ``/metrics`` and its content type; see ``metrics.exposition``."""
    if snapshot is not None and sum(len(each.routes) for each in snapshot.topics) > limits.METRIC_ROUTES_IN_THREAD:
        made = await _in_process(pickle.dumps((msgspec.json.encode(snapshot), accept, figures)))
        if made is not None:
            return made
    return await asyncio.to_thread(exposition, snapshot, accept, tuple(web_metrics(figures)))


async def _in_process(asked: bytes) -> tuple[bytes, str] | None:
    """The answer of a process; ``None`` where it fails, as without memory for it."""
    try:
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", __name__, stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE
        )
    except OSError:
        return None
    try:
        async with asyncio.timeout(limits.METRIC_PROCESS_TIMEOUT):
            answer, _ = await process.communicate(asked)
    except TimeoutError:
        return None
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    kind, _, body = answer.partition(b"\n")
    return (body, kind.decode()) if process.returncode == 0 else None


def main() -> None:
    """Read the question from the standard input, and write the content type and the body."""
    os.nice(_NICE)
    encoded, accept, figures = pickle.loads(sys.stdin.buffer.read())  # noqa: S301 - of the server that started it
    snapshot = msgspec.json.decode(encoded, type=Snapshot)
    body, kind = exposition(snapshot, accept, tuple(web_metrics(figures)))
    sys.stdout.buffer.write(kind.encode() + b"\n" + body)


if __name__ == "__main__":
    main()
