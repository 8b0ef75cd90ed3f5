"""Rounds against a script that answers as a node does: what is asked, what is read, what is said when it fails."""

from __future__ import annotations

import sys
import textwrap
from typing import TYPE_CHECKING

import pytest

from lab.bed.processes import Deadline, Process
from lab.experiments import flow

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

SAY = """
    import array, json, sys
    def say(event, **fields):
        print("@ " + json.dumps({"event": event, **fields}), flush=True)
    def write(path, numbers):
        open(path, "wb").write(array.array("Q", numbers).tobytes())
"""
SOURCE = """
    for number, size, rate, count, path in map(str.split, sys.stdin):
        write(path, [1000 * at for at in range(int(count))])
        say("sent", round=int(number), count=int(count), start_ns=0, asked=[size, rate])
"""
SINK = """
    for number, path, settle in map(str.split, sys.stdin):
        rows = [0, 0, 100, 150, 1, 0, 100, 180, 0, 1, 200, 260]
        write(path, rows)
        say("noted", round=int(number), count=len(rows) // 4, settle=float(settle))
"""
SILENT = """
    for number, path, settle in map(str.split, sys.stdin):
        write(path, [0, 0, 100, 150] * 10)
        say("noted", round=int(number), count=10)
"""
ENDS = """
    sys.stdin.readline()
"""


@pytest.fixture
def node() -> Iterator[Callable[[str], Process]]:
    """Start a script; its name is ``fake``."""
    started: list[Process] = []

    def start(body: str) -> Process:
        argv = [sys.executable, "-c", textwrap.dedent(SAY) + textwrap.dedent(body)]
        started.append(Process(argv, name="fake", commands=True))
        return started[-1]

    yield start
    for process in started:
        process.end()


def test_round_is_asked_for_and_its_lateness_read(node: Callable[[str], Process], tmp_path: Path) -> None:
    source = node(SOURCE)
    begun = flow.begin(source, tmp_path, size=64, rate=50.0, count=3)
    sent = flow.sent(begun)
    assert list(sent.columns) == ["sequence", "late_ns"]
    assert list(sent.itertuples(index=False, name=None)) == [(0, 0), (1, 1000), (2, 2000)]
    assert source.events("sent")[0]["asked"] == ["64", "50.0"]
    assert begun.seconds == pytest.approx(0.06)
    assert not list(tmp_path.iterdir())


def test_rounds_have_numbers_of_their_own_and_are_not_mixed_up(
    node: Callable[[str], Process], tmp_path: Path
) -> None:
    sources = [node(SOURCE) for _ in range(2)]
    begun = [flow.begin(source, tmp_path, size=64, rate=100.0, count=2 + at) for at, source in enumerate(sources * 2)]
    assert len({one.number for one in begun}) == 4
    assert [len(flow.sent(one)) for one in reversed(begun)] == [5, 4, 3, 2]


def test_what_came_is_read_by_topic(node: Callable[[str], Process], tmp_path: Path) -> None:
    sink = node(SINK)
    came = flow.noted(sink, ["/cmd", "/vel"], tmp_path, 7, settle=0.25)
    assert list(came.columns) == ["topic", "sequence", "due_ns", "came_ns"]
    assert list(came.itertuples(index=False, name=None)) == [
        ("/cmd", 0, 100, 150),
        ("/vel", 0, 100, 180),
        ("/cmd", 1, 200, 260),
    ]
    assert sink.events("noted") == [{"event": "noted", "round": 7, "count": 3, "settle": 0.25}]
    assert not list(tmp_path.iterdir())


def test_node_that_ends_is_named_at_once(node: Callable[[str], Process], tmp_path: Path) -> None:
    begun = flow.begin(node(ENDS), tmp_path, size=64, rate=0.001, count=10)
    with pytest.raises(Deadline, match="fake; it ended with status 0"):
        flow.sent(begun)
    with pytest.raises(Deadline, match="fake; it ended"):
        flow.noted(node(ENDS), ["/cmd"], tmp_path)


def test_silent_topic_is_named(node: Callable[[str], Process], tmp_path: Path) -> None:
    with pytest.raises(Deadline, match=r"came to fake on /vel in 0\.0 s"):
        flow.wait_flowing(node(SOURCE), node(SILENT), ["/cmd", "/vel"], tmp_path, timeout=0.0)
    flow.wait_flowing(node(SOURCE), node(SILENT), ["/cmd"], tmp_path, timeout=0.0)
