"""Path-MTU black holes: judged by samples of TCP_INFO, and remembered; no socket and no clock."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.mesh import limits
from rmpa.mesh.path_mtu import PathState, PathTable, Progress, StallWatch, TcpSample, smaller

FIRST, LEAST = limits.SEGMENT_BYTES
STUCK = TcpSample(queued=50_000, retransmits=0, acked=139, delivered=4, rtt=0.001)
HOST = "10.0.0.2"


class Lane:
    """A connection whose data stalls, sampled from time to time."""

    def __init__(self, segment: int | None = None, **changes: float) -> None:
        self.now = 100.0
        self.watch = StallWatch(segment, self.now)
        self.sample = replace(STUCK, **changes)  # type: ignore[arg-type]  # fields of it
        self.watch.look(self.sample, self.now)  # what was acknowledged until here
        self.watch.idle(self.now)

    def suspected(self) -> bool:
        return self.watch.suspected

    def look(self, after: float, retransmits: int, **changes: float) -> Progress:
        self.now += after
        self.sample = replace(self.sample, retransmits=retransmits, **changes)  # type: ignore[arg-type]  # likewise
        return self.watch.look(self.sample, self.now)


def test_lost_large_segments_are_a_black_hole() -> None:
    lane = Lane()
    assert lane.look(0.1, 0) is Progress.FLOWING
    assert lane.look(0.15, 1) is Progress.WAITING
    assert lane.look(0.1, 1) is Progress.STALLED
    lane.watch.small_passed()
    assert lane.look(0.1, 1) is Progress.WAITING
    assert not lane.suspected()
    assert lane.look(0.2, 2) is Progress.WAITING, "its acknowledgement may be on the way"
    assert lane.suspected()
    assert lane.look(0.1, 2) is Progress.BLACK_HOLE
    assert lane.now - 100.0 < limits.EXPRESS_LEASE


def test_unanswered_probe_proves_nothing() -> None:
    lane = Lane()
    for retransmits in range(1, 8):
        assert lane.look(0.4, retransmits) is Progress.STALLED
    assert not lane.suspected()


def test_a_cable_that_is_in_again_is_no_black_hole() -> None:
    """The small packet passes as soon as it is, and TCP repeats the large ones a second later."""
    lane = Lane()
    lane.look(0.25, 1)
    assert lane.look(1.0, 2) is Progress.STALLED
    lane.watch.small_passed()
    for _ in range(8):
        assert lane.look(0.1, 2) is Progress.WAITING
    assert lane.look(0.1, 0, acked=50_139, delivered=100, queued=0) is Progress.FLOWING
    assert not lane.watch.waiting
    assert lane.look(0.35, 1, queued=9000) is Progress.STALLED, "a later stall needs a proof of its own"


def test_slow_acknowledgement_is_awaited() -> None:
    lane = Lane(rtt=0.4)
    lane.look(0.5, 1)
    lane.watch.small_passed()
    lane.look(0.5, 2)
    assert lane.look(0.5, 2) is Progress.WAITING
    assert lane.look(0.2, 2) is Progress.BLACK_HOLE


def test_passed_large_segments_rule_out_a_black_hole() -> None:
    lane = Lane()
    lane.look(0.1, 0, acked=139 + 100 * 1448, delivered=104)
    for retransmits in range(1, 5):
        assert lane.look(0.5, retransmits) is Progress.WAITING


def test_passed_small_segments_prove_nothing() -> None:
    lane = Lane()
    lane.look(0.1, 0, acked=139 + 100 * 200, delivered=104)
    assert lane.look(0.5, 1) is Progress.STALLED


def test_little_data_that_stands_still_is_no_sign() -> None:
    lane = Lane(queued=limits.SEGMENT_BYTES[0] - 1)
    assert lane.look(1.0, 3) is Progress.WAITING


def test_a_window_that_is_closed_is_no_sign() -> None:
    """A stopped peer: its kernel acknowledges what it took, and nothing is retransmitted."""
    lane = Lane()
    for _ in range(20):
        assert lane.look(0.5, 0) is Progress.FLOWING


def test_the_smallest_segments_may_be_lost_too() -> None:
    lane = Lane(LEAST)
    lane.look(0.5, 1)
    lane.watch.small_passed()
    lane.look(0.5, 2)
    assert lane.look(0.5, 2) is Progress.BLACK_HOLE


def test_another_size_begins_anew_on_the_same_connection() -> None:
    lane = Lane()
    lane.look(0.1, 0, acked=90_139, delivered=70)
    lane.watch = StallWatch(FIRST, lane.now, lane.watch)
    assert lane.watch.acked == 0
    lane.look(0.1, 0, acked=91_339, delivered=71)
    assert lane.watch.acked == 1200


@given(st.lists(st.tuples(st.floats(0.01, 1.0), st.integers(0, 6), st.integers(0, 3000), st.booleans())))
def test_never_without_a_proof(looks: list[tuple[float, int, int, bool]]) -> None:
    lane = Lane()
    proven = False
    for after, retransmits, acked, answered in looks:
        if answered and lane.watch.waiting:
            lane.watch.small_passed()
            proven = True
        progress = lane.look(after, retransmits, acked=lane.sample.acked + acked)
        assert progress is not Progress.BLACK_HOLE or proven
        proven = proven and progress is not Progress.FLOWING


def test_sizes() -> None:
    assert [smaller(None), smaller(1448), smaller(FIRST), smaller(LEAST)] == [FIRST, FIRST, LEAST, None]


def test_a_path_is_remembered_for_a_while() -> None:
    table = PathTable()
    assert table.segment(HOST, 0.0) is None
    assert table.problem(HOST, None, 0.0) is None
    assert table.black_hole(HOST, None, 0.0) is PathState.TRYING
    assert table.segment(HOST, 1.0) == FIRST
    assert table.segment("10.0.0.3", 1.0) is None
    assert table.segment(HOST, limits.PATH_REMEMBERED) is None


def test_smaller_segments_that_arrive_are_news_once() -> None:
    table = PathTable()
    table.black_hole(HOST, None, 0.0)
    problem = table.problem(HOST, FIRST, 1.0)
    assert problem is not None
    assert problem.text == f"large packets to {HOST} are not acknowledged, small ones are"
    assert not table.flowed(HOST, FIRST, FIRST)
    assert not table.flowed(HOST, None, 1 << 20), "another connection, with large ones"
    assert table.flowed(HOST, FIRST, 2 * FIRST)
    assert not table.flowed(HOST, FIRST, 3 * FIRST)
    problem = table.problem(HOST, FIRST, 2.0)
    assert problem is not None
    assert "a path-MTU black hole): messages go in packets of at most 1252 bytes" in problem.text
    assert "ip link set dev NAME mtu" in problem.remedy
    assert str(problem) == f"{problem.text}; {problem.remedy}"


def test_connection_outlives_the_remembered_path() -> None:
    table = PathTable()
    problem = table.problem(HOST, FIRST, 0.0)
    assert problem is not None
    assert "1252 bytes" in problem.text


def test_further_connections_use_the_known_size() -> None:
    table = PathTable()
    table.black_hole(HOST, None, 0.0)
    assert table.black_hole(HOST, None, 0.1) is PathState.TRYING, "the other lane, or another agent of that host"
    assert table.segment(HOST, 0.2) == FIRST
    assert table.black_hole(HOST, FIRST, 1.0) is PathState.TRYING
    assert table.segment(HOST, 1.1) == LEAST


def test_large_packets_return_where_nothing_helps() -> None:
    table = PathTable()
    for segment in (None, FIRST):
        table.black_hole(HOST, segment, 0.0)
    assert table.black_hole(HOST, LEAST, 1.0) is PathState.NO_HELP
    assert table.segment(HOST, 1.0) is None
    assert table.black_hole(HOST, None, 2.0) is None
    problem = table.problem(HOST, None, 2.0)
    assert problem is not None
    assert "small packets do not help" in problem.text
    assert table.black_hole(HOST, None, 1.0 + limits.PATH_NO_HELP) is PathState.TRYING


@pytest.mark.parametrize("further", [1, 100])
def test_the_memory_is_bounded(further: int) -> None:
    table = PathTable()
    for number in range(limits.PATHS_MAX + further):
        table.black_hole(f"10.1.{number // 256}.{number % 256}", None, float(number) / 1000)
    assert len(table._paths) == limits.PATHS_MAX
    assert table.segment("10.1.0.0", 1.0) is None
