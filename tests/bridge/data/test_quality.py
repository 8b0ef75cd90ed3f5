from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from rmpa.bridge import limits
from rmpa.bridge.data.quality import PeerClockHistory, QosEvent, QosEventKind, QosWatch, Quality
from rmpa.bridge.data.route import Downsampler
from rmpa.core import limits as core_limits
from rmpa.core.contract import Contract, Liveliness
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
    assert (s.latency, s.rate, s.bandwidth, s.jitter, s.age, s.period) == (None,) * 6
    assert (s.messages, s.bytes) == (0, 0)


def test_a_clock_that_is_ahead_is_taken_off() -> None:
    quality = Quality()
    feed(quality, [1.0, 1.1], latency=0.003, ahead=-7200.0)
    s = quality.summary(clock(-7200.0, 0.0002, 1.1), 1.1)
    assert s.latency is not None
    assert s.latency.max == pytest.approx(0.003, abs=1e-6)
    assert s.latency.error == pytest.approx(0.0002 + 0.1 * mesh_limits.CLOCK_DRIFT)


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


_RATES = (1, 50, 512, 13_000, 100_000)


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
        quality.arrived(now, WALL, WALL, 104)  # with the length field
        asked = number in (int(seconds * rate * 0.6), int(seconds * rate) - 1)
        if asked and number > 2:
            for later in (0.0, burst / rate, 0.03):  # at once, before the next burst, behind a pause of our own
                s = quality.summary(None, now + later)
                assert s.rate == pytest.approx(rate, rel=0.06)
                assert s.bandwidth == pytest.approx(100 * rate, rel=0.06)
    assert quality.messages == int(seconds * rate)


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


AUTOMATIC = Contract(liveliness_lease=2.0)


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


# The history of a peer's clock.


def test_better_of_two_near_estimates_is_kept() -> None:
    clock = PeerClockHistory()
    for now, error in ((0.0, 0.01), (0.1, 0.002), (0.2, 0.01), (0.3, 0.001), (1.5, 0.01)):
        clock.add(1.0, error, now)
    assert [now for now, _, _ in clock.estimates] == [0.0, 0.3, 1.5]
