"""When a bulk lane has its connection, on two sides whose words and connections are under way for a while."""

from __future__ import annotations

import random
from dataclasses import dataclass, field

import pytest

from rmpa.mesh import limits
from rmpa.mesh.frames import LaneWord
from rmpa.mesh.lane_demand import LaneAction, LaneDemand, LaneState

WORDS = {
    LaneAction.SAY_WANT: LaneWord.WANT,
    LaneAction.SAY_LEAVE: LaneWord.LEAVE,
    LaneAction.SAY_KEEP: LaneWord.KEEP,
}


def both(*, agreed: bool = True) -> tuple[LaneDemand, LaneDemand]:
    return LaneDemand(dialled=True, agreed=agreed), LaneDemand(dialled=False, agreed=agreed)


def test_no_lane_is_dialled_before_it_is_wanted() -> None:
    dialler, acceptor = both()
    assert dialler.begin() is acceptor.begin() is LaneAction.NOTHING
    assert dialler.want() is LaneAction.DIAL
    assert acceptor.want() is LaneAction.SAY_WANT
    assert acceptor.want() is LaneAction.NOTHING, "it has asked"


def test_the_lane_of_an_earlier_release_is_dialled_with_the_link_and_stays() -> None:
    dialler, acceptor = both(agreed=False)
    assert dialler.begin() is LaneAction.DIAL
    assert acceptor.begin() is acceptor.want() is LaneAction.NOTHING, "it would not know the frame"
    for each in (dialler, acceptor):
        each.up(0.0)
        assert each.check(100 * limits.BULK_UNUSED, used=False) is LaneAction.NOTHING
    assert dialler.down(orderly=True, waiting=False) == (LaneAction.DIAL, True)


def test_the_acceptors_wish_before_the_link_is_used_is_kept() -> None:
    dialler, _ = both()
    dialler.said(LaneWord.WANT, 0.0, used=False)
    assert dialler.begin() is LaneAction.DIAL


def test_an_unused_lane_ends_by_agreement_without_loss() -> None:
    dialler, acceptor = both()
    for each in (dialler, acceptor):
        each.want()
        each.up(0.0)
    now = limits.BULK_UNUSED
    assert dialler.check(now - 0.01, used=False) is LaneAction.NOTHING
    assert acceptor.check(now, used=False) is LaneAction.NOTHING, "only the dialler proposes"
    assert dialler.check(now, used=False) is LaneAction.SAY_LEAVE
    assert acceptor.said(LaneWord.LEAVE, now, used=False) is LaneAction.CLOSE
    assert dialler.down(orderly=True, waiting=False) == (LaneAction.NOTHING, False)
    assert dialler.want() is LaneAction.DIAL


def test_a_lane_that_the_other_side_uses_stays() -> None:
    dialler, acceptor = both()
    for each in (dialler, acceptor):
        each.want()
        each.up(0.0)
    now = limits.BULK_UNUSED
    dialler.check(now, used=False)
    assert acceptor.said(LaneWord.LEAVE, now, used=True) is LaneAction.SAY_KEEP
    assert dialler.said(LaneWord.KEEP, now, used=False) is LaneAction.RESUME
    assert dialler.check(now + 1, used=False) is LaneAction.NOTHING, "it asks again after the whole time"


def test_what_waits_at_the_end_brings_the_next_lane() -> None:
    dialler, _ = both()
    dialler.want()
    dialler.up(0.0)
    dialler.check(limits.BULK_UNUSED, used=False)
    assert dialler.want() is LaneAction.NOTHING
    assert dialler.down(orderly=True, waiting=True) == (LaneAction.DIAL, False)


@pytest.mark.parametrize("word", [0, 4, 0xFFFFFFFF, LaneWord.KEEP, LaneWord.LEAVE])
def test_words_of_later_versions_and_late_ones_change_nothing(word: int) -> None:
    for each in both():
        each.up(0.0)
        state = each.state
        assert each.said(word, 1.0, used=False) in (LaneAction.NOTHING, LaneAction.SAY_KEEP)
        assert each.state is state


@dataclass
class End:
    """One side on a simulated path.

    Args:
        machine: Its machine.
        sending: Whether it may send on the present connection.
        waiting: Messages that it holds back.
        sent: Whether it has sent any since the last look.
        inbox: Time, number, kind and value of what will arrive: words, messages, connections and byes.
    """

    machine: LaneDemand
    sending: bool = False
    waiting: int = 0
    sent: bool = False
    inbox: list[tuple[float, int, str, int]] = field(default_factory=list)

    def used(self) -> bool:
        before, self.sent = self.sent, False
        return before or self.waiting > 0


class Path:
    """Both sides; what they send is under way for up to 0.3 s, in order on each lane."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)
        self.ends = [End(machine) for machine in both()]
        self.now = 0.0
        self.lane = self.sent = self.carried = self.posted = 0
        self.last: dict[tuple[int, bool], float] = {}

    def post(self, to: int, what: str, value: int) -> None:
        way = (to, what == "word")
        at = self.last[way] = max(self.last.get(way, 0.0), self.now + self.rng.random() * 0.3)
        self.posted += 1
        self.ends[to].inbox.append((at, self.posted, what, value))

    def flush(self, number: int) -> None:
        end = self.ends[number]
        while end.sending and end.waiting:
            self.post(1 - number, "message", self.lane)
            self.sent += 1
            end.waiting -= 1
            end.sent = True

    def act(self, number: int, action: LaneAction) -> None:
        end = self.ends[number]
        if action is LaneAction.DIAL:
            self.lane += 1
            self.post(1, "up", self.lane)
            self.post(0, "up", self.lane)
        elif action is LaneAction.CLOSE:
            self.post(0, "bye", self.lane)
        if action in (LaneAction.SAY_LEAVE, LaneAction.CLOSE):
            end.sending = False
        end.sending = end.sending or action is LaneAction.RESUME
        if action in WORDS:
            self.post(1 - number, "word", WORDS[action])
        self.flush(number)

    def publish(self, number: int) -> None:
        self.ends[number].waiting += 1
        self.flush(number)
        if self.ends[number].waiting:
            self.act(number, self.ends[number].machine.want())

    def take(self, number: int, what: str, value: int) -> None:
        end = self.ends[number]
        if what == "up":
            end.sending = True
            end.machine.up(self.now)
            self.flush(number)
        elif what == "message":
            assert value == self.lane, "it was sent on a connection that had ended"
            assert end.machine.state in (LaneState.UP, LaneState.LEAVING), "it arrives on a connection that ended"
            self.carried += 1
        elif what == "word":
            self.act(number, end.machine.said(value, self.now, used=end.used()))
        else:
            end.sending = False
            action, lost = end.machine.down(orderly=True, waiting=end.waiting > 0)
            assert not lost
            self.act(number, action)

    def step(self, rate: float) -> None:
        self.now += 0.05
        for number, end in enumerate(self.ends):
            if self.rng.random() < rate:
                self.publish(number)
            for entry in sorted(end.inbox):
                if entry[0] <= self.now:
                    end.inbox.remove(entry)
                    self.take(number, *entry[2:])
            self.act(number, end.machine.check(self.now, used=end.used()))


@pytest.mark.parametrize("seed", range(60))
def test_no_message_is_lost_whatever_both_want_when(seed: int) -> None:
    path = Path(seed)
    for _ in range(15):
        for _ in range(path.rng.randrange(200)):
            path.step(0.05)
        for _ in range(path.rng.randrange(1400)):  # until the lane is about to leave, or has left
            path.step(0.0)
    for _ in range(3000):
        path.step(0.0)
    assert path.carried == path.sent > 10
    assert not any(end.waiting or end.inbox for end in path.ends)
    assert {end.machine.state for end in path.ends} == {LaneState.ABSENT}
    assert path.lane > 1, "it left meanwhile, and came back"
