"""A graph of thousands is told in portions that leave room for commands."""

from __future__ import annotations

from rmpa.bridge import limits
from rmpa.bridge.actions import Pacing, Send
from rmpa.bridge.policy import Policy
from rmpa.bridge.topics.exports import Exports, LocalSource
from rmpa.config.settings import PolicySettings


def test_a_portion_waits_while_the_lane_is_busy_but_not_for_ever() -> None:
    pacing = Pacing()
    assert pacing.ready(1, 10.0, busy=False)
    assert not pacing.ready(1, 10.01, busy=True)
    assert pacing.ready(1, 10.02, busy=False), "it is free again"
    assert not pacing.ready(1, 10.02 + limits.TELL_PATIENCE / 2, busy=True)
    assert pacing.ready(1, 10.02 + 1.01 * limits.TELL_PATIENCE, busy=True), "a lane that is never free gets on too"
    assert pacing.ready(2, 10.0, busy=True), "another peer"
    pacing.forget(1)
    assert pacing.ready(1, 10.2, busy=True)


def test_a_peer_that_is_not_ready_is_told_later_and_holds_up_no_other() -> None:
    exports = Exports(Policy(PolicySettings()))
    exports.link_up(1)
    exports.link_up(2)
    for number in range(200):
        exports.graph(f"/t{number}", {"/n": LocalSource("a/B", "http://127.0.0.1:9/")})
    ready = {2}
    told = {1: 0, 2: 0}
    while actions := exports.advertise(ready.__contains__):
        for action in actions:
            assert isinstance(action, Send)
            told[action.peer] += len(action.message.added)  # type: ignore[union-attr] # an advertisement
    assert told == {1: 0, 2: 200}
    assert exports.pending
    ready.add(1)
    assert len(exports.advertise(ready.__contains__)) == 1
