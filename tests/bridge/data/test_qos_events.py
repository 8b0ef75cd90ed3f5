"""The watch over one source: every missed deadline is seen, once, by its timer; memory and cost are bounded."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.bridge import limits
from rmpa.bridge.data.quality import QosEvent, QosEventKind, QosWatch
from rmpa.core import limits as core_limits
from rmpa.core.contract import Contract, Liveliness

TICKS = st.lists(st.integers(0, 40), max_size=40).map(lambda gaps: [sum(gaps[: n + 1]) / 8 for n in range(len(gaps))])
"""Ascending times in eighths, which add without rounding."""
EIGHTHS = st.integers(1, 16).map(lambda eighths: eighths / 8)


class Timer:
    """Serves a watch as an event loop that is never late; at one instant messages come first."""

    def __init__(self, watch: QosWatch) -> None:
        self.watch = watch
        self.events: list[QosEvent] = []

    def run(self, until: float) -> None:
        """Handle what is due before ``until``."""
        while (due := self.watch.next_timer()) is not None and due < until:
            found = self.watch.handle_timer(due)
            assert len({event.kind for event in found}) == len(found)
            self.events += found
            following = self.watch.next_timer()
            assert following is None or following > due

    def arrive(self, now: float) -> None:
        self.run(now)
        self.watch.last = now


def test_nothing_to_watch() -> None:
    watch = QosWatch(Contract(), 5.0)
    assert watch.next_timer() is None
    assert watch.handle_timer(1e9) == []
    assert (watch.counts, list(watch.recent)) == (Counter(), [])
    watch.link_down(6.0)
    assert watch.next_timer() is None


def test_deadline_is_missed_once_a_period() -> None:
    watch = QosWatch(Contract(deadline=0.25), 10.0)
    assert watch.next_timer() == 10.25
    watch.last = 10.125
    assert watch.next_timer() == 10.375
    assert watch.handle_timer(10.25) == []
    assert watch.handle_timer(10.375) == [
        QosEvent(QosEventKind.DEADLINE_MISSED, 1, "no message for 250 ms; deadline 250 ms", 10.375)
    ]
    assert watch.next_timer() == 10.625
    assert watch.handle_timer(10.5) == []
    assert watch.handle_timer(10.625) == [
        QosEvent(QosEventKind.DEADLINE_MISSED, 1, "no message for 500 ms; deadline 250 ms", 10.625)
    ]
    late = QosEvent(QosEventKind.DEADLINE_MISSED, 3, "no message for 1.25 s; deadline 250 ms", 11.375)
    assert watch.handle_timer(11.375) == [late]
    assert list(watch.recent) == [QosEvent(QosEventKind.DEADLINE_MISSED, 5, late.text, 11.375)]
    assert watch.counts == {QosEventKind.DEADLINE_MISSED: 5}
    watch.last = 11.5
    assert watch.handle_timer(11.75)[0].count == 1
    assert [event.count for event in watch.recent] == [5, 1]  # another gap is another event


@given(TICKS, EIGHTHS)
def test_every_period_without_a_message_is_one_miss(arrivals: list[float], deadline: float) -> None:
    watch = QosWatch(Contract(deadline=deadline), 0.0)
    timer = Timer(watch)
    for now in arrivals:
        timer.arrive(now)
    end = (arrivals[-1] if arrivals else 0.0) + 3 * deadline + 1 / 16
    timer.run(end)
    # Messages come first at one instant: a gap of exactly n deadlines missed n - 1 of them.
    expected = sum(
        max(0, int(-(-(after - before) // deadline)) - 1) for before, after in pairwise([0.0, *arrivals, end])
    )
    assert watch.counts[QosEventKind.DEADLINE_MISSED] == expected
    assert sum(event.count for event in timer.events) == expected


@given(TICKS, EIGHTHS, st.data())
def test_late_timers_report_only_real_misses(arrivals: list[float], deadline: float, data: st.DataObject) -> None:
    watch = QosWatch(Contract(deadline=deadline), 0.0)
    at_most = 0
    for before, after in pairwise([0.0, *arrivals]):
        if data.draw(st.booleans()):
            watch.handle_timer(before)
        watch.last = after
        at_most += int((after - before) // deadline)
    last = arrivals[-1] if arrivals else 0.0
    missed_before = watch.counts[QosEventKind.DEADLINE_MISSED]
    assert missed_before <= at_most
    watch.handle_timer(last + 10.5 * deadline)
    assert watch.counts[QosEventKind.DEADLINE_MISSED] - missed_before == 10


@given(
    st.floats(core_limits.CONTRACT_TIME_MIN, 100.0),
    st.floats(0.0, 1e9),
    st.lists(st.floats(0.0, 50.0), max_size=20),
)
def test_rounding_neither_stops_nor_spins_the_timer(deadline: float, start: float, pauses: list[float]) -> None:
    watch = QosWatch(Contract(deadline=deadline), start)
    now = start
    for pause in pauses:
        now += pause
        for _ in range(3):
            due = watch.next_timer()
            assert due is not None
            now = max(now, due)
            (event,) = watch.handle_timer(now)
            assert event.count >= 1
            following = watch.next_timer()
            assert following is not None
            assert now < following <= now + deadline * (1 + 1e-6) + 1e-6
    elapsed = (now - start) / deadline
    assert abs(watch.counts[QosEventKind.DEADLINE_MISSED] - elapsed) <= 1 + elapsed * 1e-6 + 1


def test_miss_hidden_by_rounding_is_reported_next() -> None:
    watch = QosWatch(Contract(deadline=0.1), 1e6)
    now = 1e6 + 2 * 0.1  # less 1e6, this is less than twice 0.1
    assert [event.count for event in watch.handle_timer(now)] == [1]
    due = watch.next_timer()
    assert due is not None
    assert now < due < now + 1e-6
    assert [event.count for event in watch.handle_timer(due)] == [1]
    assert watch.next_timer() == 1e6 + 3 * 0.1


def test_of_many_gaps_the_last_are_remembered() -> None:
    watch = QosWatch(Contract(deadline=0.5), 0.0)
    for second in range(100):
        watch.last = float(second)
        watch.handle_timer(second + 0.5)
    assert watch.counts == {QosEventKind.DEADLINE_MISSED: 100}
    assert [event.now for event in watch.recent] == [second + 0.5 for second in range(100 - limits.WATCH_RECENT, 100)]


def test_a_sleep_of_years_costs_one_event() -> None:
    watch = QosWatch(Contract(deadline=0.001), 0.0)
    (event,) = watch.handle_timer(1e9)
    assert abs(event.count - 10**12) <= 1
    assert len(watch.recent) == 1


MANUAL = Contract(liveliness=Liveliness.MANUAL_BY_TOPIC, liveliness_lease=2.0)
AUTOMATIC = Contract(liveliness_lease=2.0)


def test_a_silent_source_is_lost_and_comes_back() -> None:
    watch = QosWatch(MANUAL, 0.0)
    watch.last = 1.0
    assert watch.next_timer() == 3.0
    assert watch.handle_timer(3.0) == [
        QosEvent(QosEventKind.LIVELINESS_LOST, 1, "no message for 2 s; lease 2 s", 3.0)
    ]
    assert watch.handle_timer(3.25) == []
    assert watch.next_timer() == 3.25 + limits.WATCH_LOOK
    watch.last = 3.375
    assert watch.handle_timer(3.5) == [QosEvent(QosEventKind.LIVELINESS_RESTORED, 1, "alive again after 500 ms", 3.5)]
    assert watch._lost_since is None
    assert watch.next_timer() == 5.375
    assert watch.counts == {QosEventKind.LIVELINESS_LOST: 1, QosEventKind.LIVELINESS_RESTORED: 1}


@given(TICKS, st.integers(4, 16).map(lambda eighths: eighths / 8))
def test_silence_is_reported_lost_and_restored_once(arrivals: list[float], lease: float) -> None:
    watch = QosWatch(Contract(liveliness=Liveliness.MANUAL_BY_TOPIC, liveliness_lease=lease), 0.0)
    timer = Timer(watch)
    for now in arrivals:
        timer.arrive(now)
    timer.run((arrivals[-1] if arrivals else 0.0) + 1 / 16)
    silences = [(before, after) for before, after in pairwise([0.0, *arrivals]) if after - before > lease]
    lost = [event.now for event in timer.events if event.kind is QosEventKind.LIVELINESS_LOST]
    restored = [event.now for event in timer.events if event.kind is QosEventKind.LIVELINESS_RESTORED]
    assert lost == [before + lease for before, _ in silences]
    assert len(restored) == len(lost) - (watch._lost_since is not None)
    for (_, after), now in zip(silences, restored, strict=False):
        assert after <= now <= after + limits.WATCH_LOOK


def test_the_link_speaks_for_an_automatic_source() -> None:
    watch = QosWatch(AUTOMATIC, 0.0)
    assert watch.next_timer() is None
    watch.link_down(5.0)
    watch.link_down(6.0)  # the first word counts
    assert watch.next_timer() == 7.0
    watch.link_up(6.5)
    assert watch.next_timer() is None
    watch.link_down(10.0)
    assert watch.handle_timer(12.0) == [QosEvent(QosEventKind.LIVELINESS_LOST, 1, "no link for 2 s; lease 2 s", 12.0)]
    assert watch.next_timer() is None  # nothing to see before the link is back
    assert watch.link_up(20.0) == [QosEvent(QosEventKind.LIVELINESS_RESTORED, 1, "alive again after 8 s", 20.0)]
    assert watch.next_timer() is None


def test_a_link_that_comes_and_goes_before_the_timer() -> None:
    watch = QosWatch(AUTOMATIC, 0.0)
    watch.link_down(0.0)
    watch.handle_timer(2.0)
    assert [event.kind for event in watch.link_up(3.0)] == [QosEventKind.LIVELINESS_RESTORED]
    watch.link_down(3.1)
    assert watch.next_timer() == 5.1
    assert [event.kind for event in watch.handle_timer(5.1)] == [QosEventKind.LIVELINESS_LOST]
    assert watch._lost_since is not None
    assert watch.next_timer() is None


def test_one_call_reports_each_kind_once() -> None:
    watch = QosWatch(
        Contract(deadline=0.5, liveliness=Liveliness.MANUAL_BY_TOPIC, liveliness_lease=1.0),
        0.0,
    )
    assert watch.next_timer() == 0.5
    assert [(event.kind, event.count) for event in watch.handle_timer(4.0)] == [
        (QosEventKind.DEADLINE_MISSED, 8),
        (QosEventKind.LIVELINESS_LOST, 1),
    ]


def test_losses_in_a_run_are_one_event() -> None:
    watch = QosWatch(Contract(lifespan=0.5), 0.0)
    assert watch.lost(1, 1.0) == QosEvent(QosEventKind.MESSAGES_LOST, 1, "1 message lost", 1.0)
    assert watch.lost(2, 1.5) == QosEvent(QosEventKind.MESSAGES_LOST, 2, "2 messages lost", 1.5)
    text = "1 message beyond the lifespan of 500 ms"
    assert watch.expired(1, 1.6) == QosEvent(QosEventKind.LIFESPAN_EXPIRED, 1, text, 1.6)
    watch.expired(3, 1.6 + limits.WATCH_RUN + 0.1)
    assert [(event.kind, event.count, event.now) for event in watch.recent] == [
        (QosEventKind.MESSAGES_LOST, 3, 1.5),
        (QosEventKind.LIFESPAN_EXPIRED, 1, 1.6),
        (QosEventKind.LIFESPAN_EXPIRED, 3, 1.6 + limits.WATCH_RUN + 0.1),
    ]
    assert watch.counts == {QosEventKind.MESSAGES_LOST: 3, QosEventKind.LIFESPAN_EXPIRED: 4}
    assert watch.recent[0].text == "3 messages lost"


def test_a_lifespan_that_the_sender_alone_has() -> None:
    assert QosWatch(Contract(), 0.0).expired(2, 1.0).text == "2 messages beyond the lifespan"


@given(
    st.lists(st.tuples(st.sampled_from(["lost", "expired", "down", "up", "arrive", "timer"]), EIGHTHS), max_size=80)
)
def test_memory_is_bounded_and_counts_hold(steps: list[tuple[str, float]]) -> None:
    watch = QosWatch(Contract(deadline=0.5, lifespan=1.0, liveliness_lease=1.0), 0.0)
    now, told = 0.0, Counter[QosEventKind]()
    for step, pause in steps:
        now += pause
        events: list[QosEvent] = []
        match step:
            case "lost":
                events = [watch.lost(2, now)]
            case "expired":
                events = [watch.expired(1, now)]
            case "down":
                watch.link_down(now)
            case "up":
                events = watch.link_up(now)
            case "arrive":
                watch.last = now
            case _:
                events = watch.handle_timer(now)
                due = watch.next_timer()
                assert due is not None
                assert due > now
        for event in events:
            told[event.kind] += event.count
            assert event.now == now
        assert len(watch.recent) <= limits.WATCH_RECENT
    assert watch.counts == told
    assert told[QosEventKind.LIVELINESS_LOST] - told[QosEventKind.LIVELINESS_RESTORED] == (
        watch._lost_since is not None
    )


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.0015, "1.5 ms"), (0.25, "250 ms"), (1.0, "1 s"), (1234.5678, "1234.57 s")]
)
def test_durations_read_well(seconds: float, text: str) -> None:
    (event,) = QosWatch(Contract(deadline=seconds), 0.0).handle_timer(seconds)
    assert event.text == f"no message for {text}; deadline {text}"
