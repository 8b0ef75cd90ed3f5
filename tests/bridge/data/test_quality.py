from __future__ import annotations

from collections import Counter
from itertools import pairwise

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from rmpa.bridge import limits
from rmpa.bridge.data.quality import PeerClockHistory, QosEvent, QosEventKind, QosWatch, Quality
from rmpa.bridge.data.route import Downsampler
from rmpa.core import limits as core_limits
from rmpa.core.contract import Contract, Liveliness
from rmpa.core.statistics import SampleSpread
from rmpa.mesh import limits as mesh_limits

# Periods, latencies and rates of one remote source.


SECOND = 1_000_000_000


WALL = 1_700_000_000 * SECOND


def clock(offset: float = 0.0, error: float = 0.0, now: float = 0.0) -> PeerClockHistory:
    """A clock with one estimate."""
    found = PeerClockHistory()
    found.add(offset, error, now)
    return found


def feed(
    quality: Quality, arrivals: list[float], *, latency: float = 0.0, ahead: float = 0.0, size: int = 100
) -> None:
    """Messages at those monotonic times, from a peer whose clock is ``ahead`` seconds ahead of ours."""
    for now in arrivals:
        wall = WALL + round(now * SECOND)
        quality.arrived(now, wall, wall + round((ahead - latency) * SECOND), size)


def test_nothing_came() -> None:
    s = Quality().summary(clock(), 5.0)
    assert (s.latency, s.rate, s.bandwidth, s.jitter, s.age) == (None,) * 5
    assert (s.period.count, s.messages, s.bytes) == (0, 0, 0)


def test_one_message_has_latency_but_no_rate() -> None:
    quality = Quality()
    feed(quality, [10.0], latency=0.004)
    s = quality.summary(clock(), 10.5)
    assert s.latency is not None
    assert s.latency.p50 == s.latency.last == pytest.approx(0.004)
    assert s.age == pytest.approx(0.5)
    assert s.rate is None


def test_a_steady_stream() -> None:
    quality = Quality()
    feed(quality, [i / 100 for i in range(1001)], latency=0.002)
    s = quality.summary(clock(), 10.0)
    assert s.rate == pytest.approx(100)
    assert s.bandwidth == pytest.approx(10_000)
    assert s.period.mean == pytest.approx(0.01)
    assert s.period.count == limits.QUALITY_WINDOW - 1
    assert s.jitter == pytest.approx(0, abs=1e-9)
    assert (s.messages, s.bytes) == (1001, 100_100)


def test_a_clock_that_is_ahead_is_taken_off() -> None:
    quality = Quality()
    feed(quality, [1.0, 1.1], latency=0.003, ahead=-7200.0)
    s = quality.summary(clock(-7200.0, 0.0002, 1.1), 1.1)
    assert s.latency is not None
    assert s.latency.max == pytest.approx(0.003, abs=1e-6)
    assert s.latency.error == pytest.approx(0.0002 + 0.1 * mesh_limits.CLOCK_DRIFT)


def test_a_stored_message_has_an_age_and_no_latency() -> None:
    quality = Quality()
    quality.arrived(1.0, WALL, WALL - 3600 * SECOND, 10)
    assert quality.summary(clock(), 1.0, latching=True).latency is None
    known = quality.summary(clock(), 1.0).latency
    assert known is not None
    assert known.last == pytest.approx(3600)
    feed(quality, [2.0], latency=0.001)
    s = quality.summary(clock(), 2.0, latching=True)
    assert s.latency is not None
    assert s.latency.count == 1
    assert s.latency.last == pytest.approx(0.001)


def test_messages_of_long_ago_do_not_count() -> None:
    quality = Quality()
    feed(quality, [0.0, 1.0, 2.0], latency=0.5)
    feed(quality, [100.0, 100.5, 101.0], latency=0.001)
    s = quality.summary(clock(), 102.0)
    assert s.period.count == 2
    assert s.rate == pytest.approx(2 / 2.0)
    assert s.latency is not None
    assert s.latency.max == pytest.approx(0.001)
    late = quality.summary(clock(), 1000.0)
    assert late.period.count == 0
    assert late.age == pytest.approx(899.0)
    assert late.latency is not None
    assert late.latency.last == pytest.approx(0.001)


def test_the_rate_of_a_source_that_died_falls() -> None:
    quality = Quality()
    feed(quality, [i / 10 for i in range(11)])
    assert quality.summary(None, 1.05).rate == pytest.approx(10)
    assert quality.summary(None, 11.0).rate == pytest.approx(10 / 11)


def test_latency_is_corrected_by_the_clock_of_its_time() -> None:
    """Clocks that drift apart by 10 ppm: a minute later the offset is another."""
    quality, known = Quality(), PeerClockHistory()
    for second in range(51):
        ahead = 2.0 + second * 1e-5
        feed(quality, [second + 0.5], latency=0.001, ahead=ahead + 5e-6)
        known.add(ahead + 1e-5, 0.0001, second + 1.0)
    s = quality.summary(known, 51.0)
    assert s.latency is not None
    assert s.latency.count == 51
    assert s.latency.min == pytest.approx(0.001, abs=2e-5)
    assert s.latency.max == pytest.approx(0.001, abs=2e-5)
    assert s.latency.error == pytest.approx(0.0001 + 0.5 * mesh_limits.CLOCK_DRIFT)


def test_latencies_before_a_clock_step_are_dropped() -> None:
    quality, known = Quality(), PeerClockHistory()
    feed(quality, [1.0, 2.0], latency=0.001)
    known.add(0.0, 0.0005, 2.5)
    known.add(0.0004, 0.0002, 3.6)  # within both bounds
    assert quality.summary(known, 3.7).latency is not None
    known.add(5.0, 0.0005, 4.0)  # the peer's clock was put five seconds forward
    assert quality.summary(known, 4.0).latency is None
    feed(quality, [4.5], latency=0.001, ahead=5.0)
    s = quality.summary(known, 4.6)
    assert s.latency is not None
    assert s.latency.count == 1
    assert s.latency.last == pytest.approx(0.001)


@pytest.mark.parametrize("stamp", [0, (1 << 64) - 1])
def test_stamps_of_a_peer_that_lies_break_nothing(stamp: int) -> None:
    quality = Quality()
    quality.arrived(1.0, WALL, stamp, 4)
    assert quality.summary(clock(), 1.0).latency is not None


@given(
    st.lists(st.tuples(st.floats(1e-4, 0.5), st.floats(0, 0.5), st.integers(0, 1 << 28)), min_size=1, max_size=60),
    st.sampled_from([2, 8, 16]),
)
def test_it_agrees_with_a_list_of_everything(messages: list[tuple[float, float, int]], window: int) -> None:
    quality = Quality(window)
    now, kept = 0.0, []
    for period, latency, size in messages:
        now += period
        wall = WALL + round(now * SECOND)
        quality.arrived(now, wall, wall - round(latency * SECOND), size)
        kept.append((now, latency, size))
    s = quality.summary(clock(), now)
    everything, kept = kept, kept[-window:]
    assert s.latency is not None
    assert s.latency.count == len(kept)
    assert s.latency.mean == pytest.approx(sum(latency for _, latency, _ in kept) / len(kept), abs=1e-6)
    periods = SampleSpread.of(after[0] - before[0] for before, after in pairwise(kept))
    assert s.period.count == periods.count
    assert s.period.max == pytest.approx(periods.max, nan_ok=True)
    if len(kept) > 1:
        # A ring that holds less than a second is helped out by marks: from one of the messages of two seconds on.
        starts = [
            i for i, one in enumerate(everything) if one[0] >= min(kept[0][0], now - 2 * limits.QUALITY_RATE_SPAN)
        ]
        possible = [_bandwidth(everything[i:]) for i in starts if everything[i][0] <= kept[0][0]]
        assert any(s.bandwidth == pytest.approx(one) for one in possible)
        if kept[-1][0] - kept[0][0] >= limits.QUALITY_RATE_SPAN:
            assert s.bandwidth == pytest.approx(_bandwidth(kept))


def _bandwidth(messages: list[tuple[float, float, int]]) -> float:
    return sum(size for _, _, size in messages[1:]) / (messages[-1][0] - messages[0][0])


_RATES = (1, 50, 400, 512, 1_000, 13_000, 100_000)


@pytest.mark.parametrize(
    ("rate", "burst"), [(rate, burst) for rate in _RATES for burst in (1, 40, 300) if burst == 1 or burst < rate / 20]
)
def test_the_rate_is_right_from_1_hz_to_100_khz(rate: int, burst: int) -> None:
    """Messages that a publisher sends evenly come in bursts, and the agent looks in between."""
    quality = Quality()
    seconds = 10.0 if rate < 1_000 else 3.5
    now = 0.0
    for number in range(int(seconds * rate)):
        now = (number // burst) * burst / rate + number % burst * 1e-6  # all of a burst at its beginning
        quality.arrived(now, WALL, WALL, 100)
        asked = number in (int(seconds * rate * 0.6), int(seconds * rate) - 1)
        if asked and number > 2:
            for later in (0.0, burst / rate, 0.03):  # at once, before the next burst, behind a pause of our own
                s = quality.summary(None, now + later)
                assert s.rate == pytest.approx(rate, rel=0.06)
                assert s.bandwidth == pytest.approx(100 * rate, rel=0.06)
    assert quality.messages == int(seconds * rate)


def test_change_of_a_fast_rate_shows_within_seconds() -> None:
    quality = Quality()
    feed(quality, [i / 20_000 for i in range(40_000)])
    assert quality.summary(None, 2.0).rate == pytest.approx(20_000, rel=0.01)
    feed(quality, [2.0 + i / 2_000 for i in range(4_000)])
    assert quality.summary(None, 4.0).rate == pytest.approx(2_000, rel=0.1)
    feed(quality, [4.0 + i / 20_000 for i in range(40_000)])
    assert quality.summary(None, 6.0).rate == pytest.approx(20_000, rel=0.01)
    assert (quality.summary(None, 16.0).rate or 0.0) < 100, "it is dead"


def test_rate_of_a_faster_source_ignores_its_past() -> None:
    quality = Quality()
    feed(quality, [i / 10 for i in range(600)])
    feed(quality, [60.0 + i / 10_000 for i in range(3_000)])
    assert quality.summary(None, 60.3).rate == pytest.approx(10_000, rel=0.1)


# The watch over one source: every missed deadline is seen, once, by its timer; memory and cost are bounded.


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
    assert QosWatch(Contract(), 0.0).expired(2, 1.0).text == "2 messages beyond the lifespan", "the sender's alone"


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


# Down-sampling: the rate is kept over every window, and the period is steady.


RATES = st.sampled_from([core_limits.CONTRACT_RATE_MIN, 0.5, 1.0, 10.0, 30.0, 1000.0, core_limits.CONTRACT_RATE_MAX])


SLACK = 0.6


"""Intervals by which the messages of a window may be nearer together: one that was half an interval late and is
followed on the beat, and the tenth by which one may be early."""


def admitted(throttle: Downsampler, times: list[float]) -> list[float]:
    """Those of some times at which a message goes, none of which waits."""
    return [now for now in times if throttle.admit(now)]


@settings(deadline=None)
@given(RATES, st.lists(st.floats(0, 3), min_size=1, max_size=120))
@example(10.0, [0.4] + [0.49, 0.51] * 20)
@example(30.0, [0.9] * 50)
def test_no_window_has_more_than_its_rate(rate: float, gaps: list[float]) -> None:
    """Each gap in intervals; every window between two admitted messages is looked at."""
    now, times = 5.0, []
    for gap in gaps:
        now += gap / rate
        times.append(now)
    went = admitted(Downsampler(rate), times)
    for first in range(len(went)):
        for last in range(first + 1, len(went)):
            assert last - first <= (went[last] - went[first]) * rate + SLACK + 1e-3


@settings(deadline=None)
@given(RATES, st.lists(st.floats(0.001, 0.2), min_size=200, max_size=200))
def test_fast_source_is_sent_at_the_full_rate(rate: float, gaps: list[float]) -> None:
    now, times = 5.0, []
    for gap in gaps:
        now += gap / rate
        times.append(now)
    went = admitted(Downsampler(rate), times)
    spent = (times[-1] - times[0]) * rate
    assert len(went) >= int(spent), "the beat is kept, not begun anew at each message that is a little late"
    for one, other in pairwise(went):
        assert 0.69 <= (other - one) * rate <= 1.31


@pytest.mark.parametrize("rate", [0.1, 30.0, 100.0, 1000.0])
@pytest.mark.parametrize("jitter", [0.0, 0.02, 0.04])
def test_a_source_at_the_same_rate_loses_nothing(rate: float, jitter: float) -> None:
    """Early and late by turns: two clocks of one rate must not lose every other message."""
    times = [(n + (jitter if n % 2 else -jitter)) / rate for n in range(1, 1000)]
    assert len(admitted(Downsampler(rate), times)) == len(times)


def test_period_begins_anew_after_a_pause() -> None:
    throttle = Downsampler(10.0)
    assert throttle.admit(0.0)
    assert throttle.due == pytest.approx(0.1)
    assert throttle.admit(100.0)
    assert throttle.due == pytest.approx(100.1)
    assert admitted(throttle, [100.0 + n / 100 for n in range(31)]) == pytest.approx([100.09, 100.19, 100.29])


# The history of a peer's clock.


def test_drift_is_no_setting() -> None:
    clock = PeerClockHistory()
    clock.add(0.0, 0.0, 0.0)
    clock.add(3600 * mesh_limits.CLOCK_DRIFT, 0.0, 3600.0)
    assert len(clock.estimates) == 2


def test_better_of_two_near_estimates_is_kept() -> None:
    clock = PeerClockHistory()
    for now, error in ((0.0, 0.01), (0.1, 0.002), (0.2, 0.01), (0.3, 0.001), (1.5, 0.01)):
        clock.add(1.0, error, now)
    assert [now for now, _, _ in clock.estimates] == [0.0, 0.3, 1.5]


@given(st.lists(st.floats(0.001, 3.0), max_size=300))
def test_a_minute_is_remembered_however_often_it_is_told(steps: list[float]) -> None:
    clock, now = PeerClockHistory(), 0.0
    for step in steps:
        now += step
        clock.add(0.0, 0.001, now)
    times = [now for now, _, _ in clock.estimates]
    assert times == sorted(times)
    assert len(times) <= limits.QUALITY_CLOCKS
    if len(times) == limits.QUALITY_CLOCKS:
        assert now - times[0] > 0.9 * limits.QUALITY_SPAN
