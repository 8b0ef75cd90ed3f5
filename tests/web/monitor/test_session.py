"""One client of the monitor: paced, acknowledged, bounded, and allowed only what its rights say."""

from __future__ import annotations

import dataclasses
import json
from typing import TYPE_CHECKING, Any

import pytest

from rmpa.web import limits
from rmpa.web.hub.node_link import FULL, Rights
from rmpa.web.hub.topics import ReceivedMessage
from rmpa.web.monitor.session import FollowLog, MonitorClose, MonitorSession, Question, Speed, Subscribe, Unsubscribe
from tests.web.monitor.patches import apply

if TYPE_CHECKING:
    from collections.abc import Iterable

STOP = Speed("/cmd_vel", 0.0, 0.0)
ALL = dataclasses.replace(FULL, drive=True)


class Page:
    """A session with a clock and the state that its page has."""

    def __init__(self, rights: Rights = ALL) -> None:
        self.now = 100.0
        self.unsent = 0
        self.details: Any = {("topic", "/odom"): {"rate": 50.0}}
        self.decoded = 0
        self.ticks = 0
        self.tick_at = 0.0
        self.n = 0
        self.session = MonitorSession(
            lambda kind, name: self.details.get((kind, name)), self._decode, rights, self.now, lambda: self.unsent
        )
        self.state: Any = None
        self.number = 0
        self.frames: list[Any] = []
        self.others: list[Any] = []

    def _decode(self, message: ReceivedMessage) -> Any:
        self.decoded += 1
        return {"x": float(message.payload[0]), "bytes": message.payload}

    def take(self, outputs: Iterable[Any]) -> list[Any]:
        """Act as the page does; the new frames."""
        new = []
        for output in outputs:
            if not isinstance(output, str):
                self.others.append(output)
                continue
            message = json.loads(output)
            if message["op"] == "tick":
                self.ticks += 1
                self.tick_at = message["at"]
                continue
            new.append(message)
            if message["op"] == "state":
                self.state = message["state"]
            elif message["op"] == "patch":
                self.state = apply(self.state, message["patch"])
            self.number = message.get("n", self.number)
        self.frames += new
        return new

    def drive(
        self,
        linear: float,
        angular: float = 0.0,
        topic: str = "/cmd_vel",
        hold: int = 1,
        at: float | None = None,
        n: int | None = None,
    ) -> list[Any]:
        """A command of the joystick; the new frames."""
        self.n += n is None
        at = self.now if at is None else at
        numbers = {"hold": hold, "n": n or self.n, "at": at}
        return self.send("drive", topic=topic, linear=linear, angular=angular, **numbers)

    @property
    def idle(self) -> bool:
        """Whether nothing but the next sign of life is due."""
        due = self.session.next_timer()
        return due is not None and due == self.session._tick

    def send(self, op: str, **args: Any) -> list[Any]:
        return self.take(self.session.receive(json.dumps({"op": op, **args}), self.now))

    def update(self, **state: Any) -> list[Any]:
        return self.take(self.session.update(state, self.now))

    def after(self, seconds: float) -> list[Any]:
        self.now += seconds
        return self.take(self.session.handle_timer(self.now))

    def message(self, handle: int, value: int, topic: str = "/odom") -> list[Any]:
        received = ReceivedMessage(topic, "a/B", memoryview(bytes([value])), int(self.now * 1e9))
        return self.take(self.session.receive_message(handle, received, self.now))


def test_a_page_has_the_state_and_then_its_changes() -> None:
    page = Page()
    assert page.update(a=1)[0]["op"] == "state"
    page.send("ack", n=1)
    page.now += 1
    assert page.update(a=1, b={"c": 2})[0] == {"op": "patch", "n": 2, "patch": {"b": {"c": 2}}}
    assert page.state == {"a": 1, "b": {"c": 2}, "detail": {}}


def test_a_state_that_did_not_change_is_not_sent() -> None:
    page = Page()
    page.update(a=1)
    page.now += 1
    assert page.update(a=1) == []


def test_patches_keep_their_distance_and_the_last_change_is_not_lost() -> None:
    page = Page()
    page.update(a=0)
    for value in range(1, 50):
        page.now += 0.01
        page.update(a=value)
        page.send("ack", n=page.number)
    assert len(page.frames) <= 5
    assert not page.idle
    page.after(limits.PATCH_PERIOD)
    assert page.state["a"] == 49
    assert page.idle


def test_a_page_that_does_not_acknowledge_gets_no_more_and_catches_up_with_one_patch() -> None:
    page = Page()
    for value in range(20):
        page.now += 1
        page.update(a=value)
    assert len(page.frames) == limits.UNACKNOWLEDGED_MAX
    assert page.idle
    assert len(page.send("ack", n=page.number)) == 1
    assert page.state["a"] == 19


def test_details_come_for_what_the_page_looks_at_alone() -> None:
    page = Page()
    page.update(a=1)
    page.now += 1
    page.send("look", at=[["topic", "/odom"], ["topic", "/none"]])
    assert page.state["detail"] == {"topic:/odom": {"rate": 50.0}}
    page.send("ack", n=page.number)
    page.now += 1
    page.send("look", at=[])
    assert page.state["detail"] == {}


def test_values_are_paced_newest_first_and_decoded_only_when_sent() -> None:
    page = Page()
    page.send("watch", id=1, topic="/odom", how="value", rate=5)
    assert page.others == [Subscribe(1, "/odom")]
    assert [frame["value"]["x"] for frame in page.message(1, 1)] == [1.0]
    for value in range(2, 20):
        page.now += 0.01
        page.message(1, value)
    assert page.decoded == 1
    assert [frame["value"]["x"] for frame in page.after(0.2)] == [19.0]


def test_a_plot_gets_every_sample() -> None:
    page = Page()
    page.send("watch", id=1, topic="/odom", how="plot", fields=["x"], rate=5)
    for value in range(10):
        page.message(1, value)
        page.now += 0.01
    page.after(1.0)
    values = [value for frame in page.frames for value in frame["columns"][1]]
    assert values == list(range(10))


def test_a_connection_that_takes_nothing_gets_no_live_frames() -> None:
    page = Page()
    page.send("watch", id=1, topic="/odom", how="value", rate=5)
    page.unsent = 1
    assert [page.message(1, value) for value in range(5)] == [[]] * 5
    page.unsent = 0
    assert [frame["value"]["x"] for frame in page.after(1.0)] == [4.0]


def test_what_cannot_be_shown_ends_the_watch_with_its_reason() -> None:
    page = Page()
    page.send("watch", id=1, topic="/odom", how="image", rate=5)
    assert page.message(1, 1)[0] == {"op": "failed", "id": 1, "error": page.frames[-1]["error"], "remedy": ""}
    assert "not an image" in page.frames[-1]["error"]
    assert page.others[-1] == Unsubscribe(1)


def test_unwatching_ends_the_subscription() -> None:
    page = Page()
    page.send("watch", id=1, topic="/odom", how="value")
    page.send("unwatch", id=1)
    assert page.others == [Subscribe(1, "/odom"), Unsubscribe(1)]
    assert page.message(1, 1) == []


def test_watches_and_questions_are_bounded() -> None:
    page = Page()
    for number in range(1, limits.WATCHES_MAX + 2):
        page.send("watch", id=number, topic="/odom", how="value")
    assert "watched already" in page.frames[-1]["error"]
    for number in range(100, 101 + limits.ASKS_MAX):
        page.send("ask", id=number, what="why")
    assert "wait for an answer" in page.frames[-1]["error"]


def test_a_question_has_one_answer() -> None:
    page = Page()
    page.send("ask", id=5, what="why", args={"name": "/odom"})
    assert page.others == [Question(5, "why", {"name": "/odom"})]
    assert page.take(page.session.answer(5, [1])) == [{"op": "answer", "id": 5, "value": [1]}]
    assert page.take(page.session.answer(5, [1])) == []
    page.send("ask", id=6, what="why")
    assert page.take(page.session.refuse(6, "no", "wait")) == [
        {"op": "failed", "id": 6, "error": "no", "remedy": "wait"}
    ]


@pytest.mark.parametrize("what", ["call", "set_param", "delete_param", "profile", "context"])
def test_who_may_only_look_can_change_nothing(what: str) -> None:
    page = Page(Rights())
    assert "only look" in page.send("ask", id=1, what=what)[0]["error"]
    assert page.others == []


def test_who_may_only_look_cannot_drive() -> None:
    page = Page(FULL)
    assert "may not drive" in page.drive(1)[0]["error"]
    assert page.others == []


def test_a_robot_is_stopped_when_nobody_commands_it_any_more() -> None:
    page = Page()
    page.drive(0.5, -1)
    page.drive(0.5, -1)
    assert page.others == [STOP, Speed("/cmd_vel", 0.5 * limits.DRIVE_SPEED, -limits.DRIVE_TURN)]
    assert page.session.next_timer() == pytest.approx(page.now + limits.DRIVE_TIMEOUT)
    page.after(limits.DRIVE_TIMEOUT / 2)
    assert len(page.others) == 2
    page.after(limits.DRIVE_TIMEOUT)
    assert page.others[2:] == [STOP]
    page.after(10)
    assert len(page.others) == 3


def test_what_tcp_kept_over_a_cut_moves_nothing() -> None:
    page = Page()
    page.drive(1)
    page.drive(1)
    made = page.now
    page.after(limits.DRIVE_TIMEOUT)
    page.after(5)  # the cable is cut, and the stick let go; then all comes at once
    del page.others[:]
    told = [frame for n in range(30) for frame in page.drive(1, at=made + n / 10)]
    assert page.others == []
    assert [frame["error"] for frame in told] == ["commands reach the server 5.3 s late, and are dropped"]
    page.send("release", hold=1)
    page.drive(1, hold=1)  # of the hold that has ended
    assert page.others == []
    page.drive(1, hold=2)
    page.drive(1, hold=2)
    assert page.others == [STOP, Speed("/cmd_vel", limits.DRIVE_SPEED, 0.0)]


def test_the_first_command_after_a_gap_is_zero() -> None:
    page = Page()
    for _ in range(2):
        page.drive(1)
        assert page.others[-1] == STOP
        page.drive(1)
        assert page.others[-1] != STOP
        page.after(limits.DRIVE_TIMEOUT)
        assert page.others[-1] == STOP


def test_no_command_counts_twice_or_behind_a_newer_one() -> None:
    page = Page()
    page.drive(0, hold=3)
    del page.others[:]
    page.drive(1, hold=2)
    page.drive(1, hold=3, n=1)
    assert page.others == []


@pytest.mark.parametrize(
    ("what", "late"), [("call", True), ("set_param", True), ("profile", True), ("params", False)]
)
def test_an_order_that_comes_late_is_not_carried_out(what: str, late: bool) -> None:
    page = Page()
    page.now += 10
    frames = page.send("ask", id=1, what=what, at=page.now - limits.ORDER_AGE - 0.1)
    assert [frame["op"] for frame in frames] == (["failed"] if late else [])
    assert len(page.others) == (not late)
    page.send("ask", id=2, what=what, at=page.now - limits.ORDER_AGE)
    assert page.others[-1].id == 2


def test_a_page_learns_the_clock_by_which_it_dates_its_commands() -> None:
    page = Page()
    (hello,) = page.take(page.session.open("pc"))
    assert hello["at"] == page.now
    page.after(limits.TICK_PERIOD)
    assert page.tick_at == page.now


@pytest.mark.parametrize("how", ["release", "close", "another topic"])
def test_a_robot_is_stopped_at_once(how: str) -> None:
    page = Page()
    page.drive(1)
    page.drive(1)
    if how == "release":
        page.send("release", hold=1)
    elif how == "close":
        page.take(page.session.close())
    else:
        page.drive(1, topic="/other")
    assert page.others[2] == STOP
    assert page.others[3:] == ([Speed("/other", 0.0, 0.0)] if how == "another topic" else [])


WATCH = {"op": "watch", "id": 1, "topic": "/a", "how": "value"}
DRIVE = {"op": "drive", "topic": "/cmd_vel", "linear": 0, "angular": 0, "hold": 1, "n": 1, "at": 0}


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        "[" * 60_000,
        "\ud800",
        '{"op": "shutdown"}',
        '{"op": "ack"}',
        json.dumps(WATCH | {"how": "plot"}),
        json.dumps(WATCH | {"rate": 1000}),
        json.dumps(DRIVE | {"linear": 9}),
        json.dumps(DRIVE | {"linear": float("nan")}),
        json.dumps({"op": "look", "at": [["topic", f"/{number}"] for number in range(limits.LOOKS_MAX + 1)]}),
        json.dumps({"op": "ask", "id": 1, "what": "x" * limits.REQUEST_MAX}),
    ],
)
def test_what_is_no_request_closes_the_connection(text: str) -> None:
    outputs = list(Page().session.receive(text.encode("utf-8", "surrogatepass"), 100.0))
    assert isinstance(outputs[-1], MonitorClose)
    assert len(outputs[-1].reason.encode()) <= 123
    assert outputs[-1].refusal == ("message_size" if len(text) > limits.REQUEST_MAX else "message")


@pytest.mark.parametrize("topic", ["odom", "", "/<b>", "/a//b"])
def test_a_name_that_is_none_fails_and_the_page_stays(topic: str) -> None:
    page = Page(Rights(drive=True))
    (failed,) = page.send("watch", id=1, topic=topic, how="value")
    assert (failed["op"], failed["id"]) == ("failed", 1)
    (failed,) = page.drive(0, topic=topic)
    assert (failed["op"], failed["id"]) == ("failed", 0)
    assert page.others == []


def test_a_flood_closes_the_connection() -> None:
    page = Page()
    for _ in range(int(limits.REQUEST_BURST) + 1):
        page.send("ack", n=0)
    assert isinstance(page.others[-1], MonitorClose)
    assert page.others[-1].refusal == "message_rate"


def test_new_lines_of_the_log_are_left_out_for_a_slow_page_and_kept_ones_are_not() -> None:
    page = Page()
    page.send("log", on=True)
    assert page.others == [FollowLog(True)]
    assert page.take(page.session.log([{"text": "a"}]))[0]["lines"] == [{"text": "a"}]
    page.unsent = 5
    assert page.take(page.session.log([{"text": "b"}])) == []
    assert page.take(page.session.log([{"text": "c"}], kept=True))[0]["lines"] == [{"text": "c"}]


def test_the_first_message_says_what_the_page_may_do() -> None:
    page = Page(Rights(control=True))
    assert page.take(page.session.open("pc"))[0]["may"] == ["control"]


def test_a_page_gets_signs_of_life_while_nothing_changes() -> None:
    page = Page()
    page.update(a=1)
    for _ in range(3):
        due = page.session.next_timer()
        assert due is not None
        page.now = due
        page.after(0)
    assert page.ticks == 3
    assert len(page.frames) == 1


def test_a_page_that_takes_nothing_costs_no_processor_time() -> None:
    page = Page()
    page.send("watch", id=1, topic="/odom", how="value", rate=10)
    page.unsent = 1000
    page.message(1, 5)
    page.after(1)
    due = page.session.next_timer()
    assert due is not None
    assert due >= page.now + limits.UNSENT_RETRY
    page.unsent = 0
    assert page.after(limits.UNSENT_RETRY)[0]["op"] == "value"


@pytest.mark.parametrize("id_", [0, -1, 2**32])
def test_an_id_that_no_picture_can_carry_closes_the_connection(id_: int) -> None:
    page = Page()
    page.send("watch", id=id_, topic="/image", how="image")
    assert isinstance(page.others[-1], MonitorClose)


def test_a_robot_is_stopped_while_the_page_takes_nothing() -> None:
    page = Page()
    page.drive(1)
    page.unsent = 10_000_000
    due = page.session.next_timer()
    assert due is not None
    assert due <= page.now + limits.DRIVE_TIMEOUT
    page.after(limits.DRIVE_TIMEOUT)
    assert page.others[-1] == Speed("/cmd_vel", 0.0, 0.0)
