"""Topics over cables that are pulled: reliable loses, doubles and moves nothing; best effort is fresh afterwards."""

from __future__ import annotations

import itertools
import time
from pathlib import Path

import msgspec
import pytest

from lab.bed.processes import Process, eventually
from tests.interop.conftest import ModuleFactory
from tests.interop.modules import Module
from tests.interop.recordings import connected, recorded, wait_last

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]

KINDS = ("roscpp", "rospy")
# At 1 kHz.
COUNT = 10_000


def contract(depth: int, more: str = "") -> str:
    """A reliable topic."""
    return f'[[contract]]\ntopics = ["/chatter"]\nreliability = "reliable"\ndepth = {depth}\n{more}'


def stream(a: Module, b: Module, tmp_path: Path) -> tuple[list[Process], Process, int]:
    """A recorder of each kind at ``b`` that has nothing yet, a teller at ``a``, and the last number that all have."""
    heard = [b.ros.node(kind, "recorder", topic="/chatter", nodelay=True, commands=True) for kind in KINDS]
    teller = a.ros.roscpp("teller", topic="/chatter", nodelay=True, wait=1, commands=True)
    first = connected(teller, heard)
    for listener in heard:
        recorded(listener, tmp_path)
    return heard, teller, first


def route(module: Module) -> dict[str, object]:
    """What ``rmpa topic info --json`` says of the route, asked without a process: some states last for seconds."""
    (topic,) = (topic for topic in module.agent.snapshot().topics if topic.name == "/chatter")
    (found,) = topic.routes
    return dict(msgspec.to_builtins(found))


@pytest.mark.parametrize(
    ("outage", "cuts", "pause"),
    [(0.3, 5, 1.4), pytest.param(2.5, 2, 2.0, marks=pytest.mark.long)],
    ids=["short", "long"],
)
def test_nothing_is_lost_doubled_or_moved(
    modules: ModuleFactory, tmp_path: Path, outage: float, cuts: int, pause: float
) -> None:
    a, b = modules("a", "b", config=contract(depth=2 * COUNT))
    heard, teller, first = stream(a, b, tmp_path)
    teller.tell(f"64 {COUNT} 1000")
    for number in range(cuts):
        time.sleep(pause)
        (b, a)[number % 2].host.outage(outage)
    last = int(str(teller.wait_event("told", where=lambda event: event["sent"] == first + COUNT)["sent"]))
    for listener in heard:
        wait_last(listener, last)
        rows = recorded(listener, tmp_path)
        assert not any(row.bad for row in rows)
        sequences = [row.sequence for row in rows]
        assert sequences == list(range(first + 1, last + 1)), jumps(sequences)
    assert (route(b)["lost"], route(b)["events"]) == (0, {})
    if outage > 1.0:  # the lease
        assert a.agent.process.output.count("b is back") == b.agent.process.output.count("a is back") >= cuts


def jumps(sequences: list[int]) -> str:
    """Where a row of numbers is not one, for a failure's text."""
    pairs = itertools.pairwise(sequences)
    return f"{len(sequences)} numbers; {[(one, other) for one, other in pairs if other != one + 1][:10]}"


def test_large_reliable_messages_survive_too(modules: ModuleFactory, tmp_path: Path) -> None:
    a, b = modules("a", "b", config=contract(depth=100))
    for module in (a, b):
        module.host.shape("200mbit")
    heard, teller, first = stream(a, b, tmp_path)
    last = first + 60
    teller.tell("2000000,100,1000 60 10")  # 8 s of the cable's time are 6 s of the teller's
    for _ in range(3):
        time.sleep(1.0)
        b.host.outage(0.8)
    for listener in heard:
        wait_last(listener, last, 40.0)
        rows = recorded(listener, tmp_path)
        assert not any(row.bad for row in rows)
        sequences = [row.sequence for row in rows][-60:]
        assert sequences == list(range(last - 59, last + 1)), jumps(sequences)


def test_losses_beyond_the_buffer_are_counted_exactly(modules: ModuleFactory, tmp_path: Path) -> None:
    a, b = modules("a", "b", config=contract(depth=500))
    heard, teller, first = stream(a, b, tmp_path)
    teller.tell("64 4000 1000")
    time.sleep(0.5)
    b.host.outage(2.0)
    last = first + 4000
    teller.wait_event("told", where=lambda event: event["sent"] == last)
    missing = []
    for listener in heard:
        wait_last(listener, last)
        sequences = [row.sequence for row in recorded(listener, tmp_path)]
        assert sequences == sorted(set(sequences))
        assert (sequences[0], sequences[-1]) == (first + 1, last)
        missing.append(4000 - len(sequences))
    assert missing[0] == missing[1] > 1000
    found = route(b)
    assert (found["lost"], found["events"]) == (missing[0], {"messages_lost": missing[0]})
    recent = [(event["count"], event["text"]) for event in found["recent"]]  # type: ignore[attr-defined]  # promised
    assert recent == [(missing[0], f"{missing[0]} messages lost")]
    b.agent.process.wait_for(rf"(?i)warning.*/chatter.*\b{missing[0]} messages lost")


@pytest.mark.long
def test_after_an_outage_beyond_the_contract_messages_may_be_lost(modules: ModuleFactory, tmp_path: Path) -> None:
    a, b = modules("a", "b", config=contract(100_000, 'outage = "4 s"\n'))
    heard, teller, first = stream(a, b, tmp_path)
    away: dict[str, object] = {}

    def is_away() -> bool:  # asked once: the route is there for the four seconds alone
        away.update(route(a))
        return away["state"] == "away"

    teller.tell("64 4000 200")  # for so long that a busy machine has brought the link back before the last one
    time.sleep(0.5)
    b.host.outage(1.5)  # less than it, for the link falls a second later
    eventually(lambda: route(a)["state"] == route(b)["state"] == "open", what="the link")
    assert (route(a)["lost"], route(b)["lost"], route(b)["events"]) == (0, 0, {})
    b.host.cut()
    eventually(is_away, what="the lease")
    assert away["peer"] == "b"
    assert "b is away for" in str(away["problem"])
    a.agent.process.wait_for(r"warning.* b has been away for [\d.]+ s: \d+ messages for it are given up, of /chatter")
    b.host.restore()
    for listener in heard:
        wait_last(listener, first + 4000)
    found = route(b)
    assert (found["lost"], found["events"]) == (0, {"loss_unknown": 1})
    b.agent.process.wait_for(r"(?i)warning.*/chatter.*messages may be lost, not counted")
    teller.tell("64 4000 200")  # of a publisher that has fallen silent `why` says that alone
    eventually(lambda: "loss unknown 1 times" in b.agent.rmpa("why", "a:/chatter")[1], what="the loss in rmpa why")


@pytest.mark.long
def test_a_topic_of_which_the_newest_counts_is_fresh_after_a_cut(modules: ModuleFactory, tmp_path: Path) -> None:
    a, b = modules("a", "b", config='[[contract]]\ntopics = ["/chatter"]\ndepth = 1\n')
    heard, teller, first = stream(a, b, tmp_path)
    teller.tell(f"64 {COUNT // 2} 1000")
    for _ in range(2):
        time.sleep(1.0)
        b.host.outage(0.6)
    for listener in heard:
        wait_last(listener, first + COUNT // 2)
        rows = recorded(listener, tmp_path)
        sequences = [row.sequence for row in rows]
        assert sequences == sorted(set(sequences))
        # Half a second of messages waited for the cable; they give way to those that follow.
        stale = [row for row in rows if row.age > 0.15]
        assert len(stale) <= 100, "a pause of a busy machine, and not the 1200 of both cuts"


def test_best_effort_loses_nothing_in_a_cut_of_a_second(modules: ModuleFactory, tmp_path: Path) -> None:
    """As under one roscore, whose connections stand such a cut."""
    a, b = modules("a", "b")
    heard, teller, first = stream(a, b, tmp_path)
    teller.tell("64 400 50")
    for seconds in (0.1, 0.3, 0.5, 1.0):
        time.sleep(0.5)
        b.host.outage(seconds)
    for listener in heard:
        wait_last(listener, first + 400)
        assert [row.sequence for row in recorded(listener, tmp_path)] == list(range(first + 1, first + 401))
    assert route(b)["lost"] == 0


def test_the_last_word_before_a_cut_still_counts(modules: ModuleFactory, tmp_path: Path) -> None:
    """TCP repeats it at once when the cable is in again, if the link is still the same.

    After more than half a second TCP repeats so rarely that the silence may end the link first. A topic whose last
    message counts then is reliable or latched.
    """
    a, b = modules("a", "b")
    heard, teller, first = stream(a, b, tmp_path)
    b.host.cut()
    teller.tell("64 1 0")
    time.sleep(0.3)
    b.host.restore()
    for listener in heard:
        wait_last(listener, first + 1)
