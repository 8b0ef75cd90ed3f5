"""One client of the monitor: paced, acknowledged, bounded, and allowed only what its rights say."""

from __future__ import annotations

import dataclasses
import json
import struct
from types import SimpleNamespace
from typing import Any

import pytest

from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.web.hub.frame_writer import Opcode
from rmpa.web.hub.node_link import FULL, Rights
from rmpa.web.hub.topics import ReceivedMessage
from rmpa.web.monitor import driving, limits
from rmpa.web.monitor.driving import Sticks
from rmpa.web.monitor.session import MonitorSession
from tests.web.monitor.patches import apply
from tests.web.monitor.test_sticks import Bus
from tests.web.recorder import Asked, FakeHub, PageConnection, Recorded

STOP = ("/cmd_vel", 0.0, 0.0)
ALL = dataclasses.replace(FULL, drive=True)


class Page(Recorded):
    """A session with a clock and the state that its page has."""

    def __init__(self, rights: Rights = ALL, sticks: Sticks | None = None) -> None:
        self.now = 100.0
        self.details: Any = {("topic", "/odom"): {"rate": 50.0}}
        self.picture = False
        self.decoded = self.ticks = self.n = self.number = 0
        self.tick_at = 0.0
        self.state: Any = None
        self.stick: Any = None
        self.news: list[Any] = []
        self.kept: list[Any] = []
        made: Any = Bus()
        monitor: Any = SimpleNamespace(
            module="pc",
            details=self._details,
            follow=lambda *_: None,
            unfollow=lambda _: None,
            answers=SimpleNamespace(answer=self._asked),
            sticks=sticks or Sticks(made, lambda: "pc", lambda: self.now),
        )
        hub: Any = FakeHub()
        hub.values = self._decode
        super().__init__(MonitorSession(hub, rights, "page", monitor, lambda: self.now))
        self.now = 100.0
        self.page = self.connection = self.session.connection = PageConnection(self)
        self.session.opened()
        (self.hello,) = self.take()
        self.news.clear()

    def _details(self, kind: str, name: str) -> Any:
        return self.details.get((kind, name))

    def _decode(self, message: ReceivedMessage) -> Any:
        self.decoded += 1
        if self.picture:
            return {"width": 1, "height": 1, "encoding": "mono8", "step": 1, "data": message.payload}
        return {"x": float(message.payload[0]), "bytes": message.payload}

    def _asked(self, what: str, args: Any) -> Asked:
        self.asked.append(Asked("ask", question=what, args=args))
        return self.asked[-1]

    def take(self) -> list[Any]:
        """Act as the page does; the new frames but signs of life."""
        new = []
        for opcode, (data,) in self.page.sent:
            if opcode is Opcode.BINARY:
                new.append(bytes(data))
                continue
            message = json.loads(bytes(data))
            if message["op"] == "tick":
                self.ticks += 1
                self.tick_at = message["at"]
                continue
            if message["op"] == "stick":
                self.stick = message
                continue
            new.append(message)
            if message["op"] == "state":
                self.state = message["state"]
            elif message["op"] == "patch":
                self.state = apply(self.state, message["patch"])
            self.number = message.get("n", self.number)
        self.page.sent.clear()
        self.news += new
        return new

    def drive(self, linear: float, angular: float = 0.0, topic: str = "/cmd_vel", **numbers: Any) -> list[Any]:
        """A command of the joystick; the new frames."""
        self.n += "n" not in numbers
        made = {"hold": 1, "at": self.now, "n": self.n, **numbers}
        return self.send("drive", topic=topic, linear=linear, angular=angular, **made)

    @property
    def speeds(self) -> list[tuple[str, float, float]]:
        """What was published for robots."""
        made = [(each.topic, struct.unpack("<6d", data)) for each in self.all("advertise") for data in each.published]
        return [(topic, speed[0], speed[5]) for topic, speed in made]

    @property
    def idle(self) -> bool:
        """Whether nothing but the next sign of life is due."""
        return bool(self.session.next_timer() == self.session._tick)

    def send(self, op: str, **args: Any) -> list[Any]:
        self.send_raw(json.dumps({"op": op, **args}))
        return self.take()

    def update(self, **state: Any) -> list[Any]:
        self.session._update(state)
        return self.take()

    def after(self, seconds: float) -> list[Any]:
        self.now += seconds
        self.session.handle_timer(self.now)
        return self.take()

    def message(self, value: int, kind: str = "a/B") -> list[Any]:
        """A message for the newest watch; the new frames, without beats."""
        view = memoryview(bytes([value]))
        self.last("subscribe").receive(ReceivedMessage("/odom", kind, view, int(self.now * 1e9)))
        return [frame for frame in self.take() if isinstance(frame, bytes) or frame["op"] != "beat"]

    @property
    def beats(self) -> list[Any]:
        """What was told of the rate of a watch."""
        return [frame for frame in self.news if not isinstance(frame, bytes) and frame["op"] == "beat"]


@pytest.fixture
def page() -> Page:
    return Page()


@pytest.fixture(autouse=True)
def _no_ramp(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands are obeyed at once; ``test_driving.py`` has the ramp."""
    monkeypatch.setattr(driving, "ramped", lambda _value, wanted, _step: wanted)


def test_a_page_has_the_state_and_then_its_changes_alone(page: Page) -> None:
    assert page.update(a=1)[0]["op"] == "state"
    page.send("ack", n=1)
    page.now += 1
    assert page.update(a=1, b={"c": 2})[0] == {"op": "patch", "n": 2, "patch": {"b": {"c": 2}}}
    assert page.state == {"a": 1, "b": {"c": 2}, "detail": {}}
    page.now += 1
    assert page.update(a=1, b={"c": 2}) == []


def test_patches_keep_their_distance_and_the_last_change_is_not_lost(page: Page) -> None:
    page.update(a=0)
    for value in range(1, 50):
        page.now += 0.01
        page.update(a=value)
        page.send("ack", n=page.number)
    assert len(page.news) <= 5
    assert not page.idle
    page.after(limits.PATCH_PERIOD)
    assert page.state["a"] == 49
    assert page.idle


def test_a_page_that_does_not_acknowledge_gets_no_more_and_catches_up_with_one_patch(page: Page) -> None:
    for value in range(20):
        page.now += 1
        page.update(a=value)
    assert len(page.news) == limits.UNACKNOWLEDGED_MAX
    assert page.idle
    assert len(page.send("ack", n=page.number)) == 1
    assert page.state["a"] == 19


def test_details_come_for_what_the_page_looks_at_alone(page: Page) -> None:
    page.update(a=1)
    page.now += 1
    page.send("look", at=[["topic", "/odom"], ["topic", "/none"]])
    assert page.state["detail"] == {"topic:/odom": {"rate": 50.0}}
    page.send("ack", n=page.number)
    page.now += 1
    page.send("look", at=[])
    assert page.state["detail"] == {}


def test_values_are_paced_newest_first_and_decoded_only_when_sent(page: Page) -> None:
    page.send("watch", id=1, topic="/odom", how="value", rate=5)
    assert [(each.what, each.topic) for each in page.asked] == [("subscribe", "/odom")]
    assert [frame["value"]["x"] for frame in page.message(1)] == [1.0]
    for value in range(2, 20):
        page.now += 0.01
        page.message(value)
    assert page.decoded == 1
    assert [frame["value"]["x"] for frame in page.after(0.2) if frame["op"] == "value"] == [19.0]


def test_a_plot_gets_every_sample(page: Page) -> None:
    page.send("watch", id=1, topic="/odom", how="plot", fields=["x"], rate=5)
    for value in range(10):
        page.message(value)
        page.now += 0.01
    page.after(1.0)
    values = [value for frame in page.news if "columns" in frame for value in frame["columns"][1]]
    assert values == list(range(10))


def test_a_page_is_told_the_rate_of_all_messages_and_when_the_last_one_is_old(page: Page) -> None:
    page.send("watch", id=1, topic="/odom", how="value", rate=5)
    for period, after in ((0.1, 2.0), (1.0, 5.0)):
        for value in range(40):
            page.message(value)
            page.now += period
        assert page.beats[-1] == {"op": "beat", "id": 1, "rate": pytest.approx(1 / period, 0.11), **page.beats[-1]}
        assert page.beats[-1]["after"] == pytest.approx(after, 0.11)
    assert len(page.beats) < 20


def test_a_page_that_has_not_drawn_its_pictures_gets_no_more_of_them(page: Page) -> None:
    page.picture = True
    page.send("watch", id=1, topic="/odom", how="image", rate=10, width=640)

    def came(count: int) -> int:
        for value in range(count):
            page.message(value, "sensor_msgs/Image")
            page.now += 0.5
        return sum(isinstance(frame, bytes) for frame in page.news)

    assert came(5) == limits.UNSEEN_MAX
    page.send("seen", ids=[1, 99])
    assert came(5) == limits.UNSEEN_MAX + 1
    page.send("seen", ids=[1, 1])
    assert came(5) == limits.UNSEEN_MAX + 3


def test_what_cannot_be_shown_ends_the_watch_with_its_reason_and_unwatching_without(page: Page) -> None:
    page.send("watch", id=1, topic="/odom", how="image", rate=5)
    (failed,) = page.message(1)
    assert (failed["op"], failed["id"], failed["remedy"]) == ("failed", 1, "")
    assert "not an image" in failed["error"]
    assert page.last("subscribe").closed
    page.send("watch", id=1, topic="/odom", how="value")
    page.send("unwatch", id=1)
    assert page.last("subscribe").closed
    assert page.message(1) == []


def test_watches_and_questions_are_bounded(page: Page) -> None:
    for number in range(1, limits.WATCHES_MAX + 2):
        page.send("watch", id=number, topic="/odom", how="value")
    assert "watched already" in page.news[-1]["error"]
    for number in range(100, 101 + limits.ASKS_MAX):
        page.send("ask", id=number, what="why")
    assert "wait for an answer" in page.news[-1]["error"]


def test_a_question_has_one_answer(page: Page) -> None:
    page.send("ask", id=5, what="why", args={"name": "/odom"})
    asked = page.last("ask")
    assert (asked.question, asked.args) == ("why", {"name": "/odom"})
    for frames in ([{"op": "answer", "id": 5, "value": [1]}], []):
        asked.done([1])
        assert page.take() == frames
    page.send("ask", id=6, what="why")
    page.last("ask").failed(PeerRefused("arm", "no", "wait"))
    assert page.take() == [{"op": "failed", "id": 6, "error": "arm refused: no", "remedy": "wait", "code": "refused"}]


def test_who_may_only_look_can_change_and_drive_nothing() -> None:
    orders = ("call", "set_param", "delete_param", "profile", "context")
    for what in (*orders, "launch", "description", "check_description", "save_description"):
        page = Page(Rights())
        assert "only look" in page.send("ask", id=1, what=what)[0]["error"]
        assert page.asked == []
    page = Page(FULL)
    assert "may not drive" in page.drive(1)[0]["error"]
    assert page.speeds == []


def test_a_robot_is_stopped_when_nobody_commands_it_any_more(page: Page) -> None:
    page.drive(0.5, -1)
    page.drive(0.5, -1)
    driven = [STOP, ("/cmd_vel", 0.5 * limits.DRIVE_SPEED, -limits.DRIVE_TURN)]
    assert page.session.next_timer() == pytest.approx(page.now + limits.DRIVE_TIMEOUT)
    for seconds, stops in ((0, 0), (limits.DRIVE_TIMEOUT / 2, 0), (limits.DRIVE_TIMEOUT, 1), (10, 1)):
        page.after(seconds)
        assert page.speeds == driven + [STOP] * stops


def test_what_tcp_kept_over_a_cut_moves_nothing(page: Page) -> None:
    page.drive(1)
    page.drive(1)
    made = page.now
    page.after(limits.DRIVE_TIMEOUT)
    page.after(5)  # the cable is cut, and the stick let go; then all comes at once
    page.asked.clear()
    page.session._driver = None
    told = [frame for n in range(30) for frame in page.drive(1, at=made + n / 10)]
    assert page.speeds == []
    assert [frame["error"] for frame in told] == ["commands reach the server 5.3 s late, and are dropped"]
    page.send("release", hold=1)
    page.drive(1, hold=1)  # of the hold that has ended
    assert page.speeds == []
    page.drive(1, hold=2)
    page.drive(1, hold=2)
    assert page.speeds == [STOP, ("/cmd_vel", limits.DRIVE_SPEED, 0.0)]


def test_the_first_command_after_a_gap_is_zero(page: Page) -> None:
    for _ in range(2):
        page.drive(1)
        page.drive(1)
        page.after(limits.DRIVE_TIMEOUT)
    assert [speed == STOP for speed in page.speeds] == [True, False, True] * 2


def test_no_command_counts_twice_or_behind_a_newer_one(page: Page) -> None:
    page.drive(0, hold=3)
    page.asked.clear()
    page.session._driver = None
    page.drive(1, hold=2)
    page.drive(1, hold=3, n=1)
    assert page.speeds == []


@pytest.mark.parametrize(
    ("what", "late"), [("call", True), ("set_param", True), ("profile", True), ("params", False)]
)
def test_an_order_that_comes_late_is_not_carried_out(page: Page, what: str, late: bool) -> None:
    page.now += 10
    frames = page.send("ask", id=1, what=what, at=page.now - limits.ORDER_AGE - 0.1)
    assert [frame["op"] for frame in frames] == (["failed"] if late else [])
    assert len(page.asked) == (not late)
    page.send("ask", id=2, what=what, at=page.now - limits.ORDER_AGE)
    assert len(page.asked) == 1 + (not late)


@pytest.mark.parametrize("how", ["release", "close", "another topic"])
def test_a_robot_is_stopped_at_once(page: Page, how: str) -> None:
    page.drive(1)
    page.drive(1)
    if how == "release":
        page.send("release", hold=1)
    elif how == "close":
        page.session.closing()
    else:
        page.drive(1, topic="/other")
    assert page.speeds[2] == STOP
    assert page.speeds[3:] == ([("/other", 0.0, 0.0)] if how == "another topic" else [])


def test_a_topic_of_another_type_is_driven_by_it_and_stopped_by_any_page(page: Page) -> None:
    page.session.hub.graph.add_topic("/car", "ackermann_msgs/AckermannDrive")
    told = page.drive(1, topic="/car")
    assert told[0]["error"].startswith("/car has the type ackermann_msgs/AckermannDrive")
    assert page.speeds == []
    for _ in range(2):
        page.drive(1, topic="/car", type="ackermann_msgs/AckermannDrive", hold=2)
    other = Page(sticks=page.session._monitor.sticks)
    other.session.hub.graph.add_topic("/car", "ackermann_msgs/AckermannDrive")
    other.send("stick", topic="/car", want="stop")
    published = [(each.type, struct.unpack("<5f", data)) for each in page.all("advertise") for data in each.published]
    assert [(type_, values[2]) for type_, values in published] == [
        ("ackermann_msgs/AckermannDrive", speed) for speed in (0.0, limits.DRIVE_SPEED, 0.0)
    ]
    assert [struct.unpack("<5f", data) for data in other.last("advertise").published] == [(0.0,) * 5]


def test_a_topic_whose_type_changes_is_stopped_with_the_old_one(page: Page) -> None:
    page.drive(1)
    page.drive(1)
    page.session.hub.graph.add_topic("/cmd_vel", "geometry_msgs/TwistStamped")
    page.drive(1)
    assert page.speeds[-1] == STOP
    assert page.last("advertise").closed


WATCH = {"op": "watch", "id": 1, "topic": "/a", "how": "value"}


def pair() -> tuple[Page, Page]:
    """Two pages of one server, both of which show the joystick."""
    made: Any = Bus()
    sticks = Sticks(made, lambda: "pc", lambda: 100.0)
    first, second = Page(sticks=sticks), Page(sticks=sticks)
    for each in (first, second):
        each.send("stick", topic="/cmd_vel", want="look")
        assert each.stick == {
            "op": "stick", "topic": "/cmd_vel", "holder": None, "mine": False, "problem": ""
        }  # fmt: skip
    return first, second


def test_two_pages_never_drive_one_robot_in_turns() -> None:
    first, second = pair()
    first.send("stick", topic="/cmd_vel", want="take")
    first.drive(1)
    first.drive(1)
    second.take()
    assert (second.stick["mine"], second.stick["holder"]["by"], second.stick["holder"]["module"]) == (
        False, "page", "pc"
    )  # fmt: skip
    (told,) = [frame for _ in range(5) for frame in second.drive(-1)]
    assert "the page of page at pc has it" in told["error"]
    assert second.speeds == []
    second.send("release", hold=1)
    assert second.speeds == [], "a zero of it would land between the commands of the other"


def test_the_one_from_which_it_is_taken_over_is_told_and_drives_no_more() -> None:
    first, second = pair()
    first.drive(1)
    first.drive(1)
    second.send("stick", topic="/cmd_vel", want="over")
    assert second.stick["mine"]
    (told,) = first.take()
    assert "has taken the stick over" in told["error"]
    assert (first.stick["mine"], first.speeds[-1]) == (False, STOP)
    count = len(first.speeds)
    second.drive(0.5, hold=7)
    second.drive(0.5, hold=7)
    second.send("stick", topic="/cmd_vel", want="leave")
    first.drive(1)
    first.drive(1)
    assert len(first.speeds) == count, "the stick that is still pressed there moves nothing, though it is free"
    first.drive(1, hold=2)
    first.drive(1, hold=2)
    assert first.speeds[-1] == ("/cmd_vel", limits.DRIVE_SPEED, 0.0)


def test_every_page_may_stop_the_robot() -> None:
    made: Any = Bus()
    sticks = Sticks(made, lambda: "pc", lambda: 100.0)
    first, second = Page(sticks=sticks), Page(Rights(), sticks)
    first.drive(1)
    first.drive(1)
    second.send("stick", topic="/cmd_vel", want="take")
    assert "may not drive" in second.news[-1]["error"]
    second.send("stick", topic="/cmd_vel", want="stop")
    assert second.asked == [], "it publishes nothing itself"
    assert first.speeds[-1] == STOP
    assert "has stopped the robot" in first.take()[-1]["error"]
    count = len(first.speeds)
    first.drive(1)
    assert len(first.speeds) == count


@pytest.mark.parametrize("how", ["the page has gone", "another topic"])
def test_a_page_that_leaves_lets_the_stick_go(how: str) -> None:
    first, second = pair()
    first.drive(1)
    if how == "another topic":
        first.send("stick", topic="/other", want="look")
    else:
        first.session.closing()
    second.take()
    assert second.stick["holder"] is None
    assert first.speeds[-1] == STOP


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
        *(json.dumps(WATCH | {"id": number}) for number in (0, -1, 2**32)),  # no picture can carry it
        json.dumps(DRIVE | {"linear": 9}),
        json.dumps(DRIVE | {"linear": float("nan")}),
        json.dumps({"op": "look", "at": [["topic", f"/{number}"] for number in range(limits.LOOKS_MAX + 1)]}),
        json.dumps({"op": "ask", "id": 1, "what": "x" * limits.REQUEST_MAX}),
    ],
)
def test_what_is_no_request_closes_the_connection(page: Page, text: str) -> None:
    page.send_raw(text.encode("utf-8", "surrogatepass"))
    assert page.page.ended == [1008]
    assert len(page.page.reason.encode()) <= 123
    assert page.page.refusal == ("message_size" if len(text) > limits.REQUEST_MAX else "message")


@pytest.mark.parametrize("topic", ["odom", "", "/<b>", "/a//b"])
def test_a_name_that_is_none_fails_and_the_page_stays(topic: str) -> None:
    page = Page(Rights(drive=True))
    (failed,) = page.send("watch", id=1, topic=topic, how="value")
    assert (failed["op"], failed["id"]) == ("failed", 1)
    (failed,) = page.drive(0, topic=topic)
    assert (failed["op"], failed["id"]) == ("failed", 0)
    assert page.asked == []


def test_a_flood_closes_the_connection(page: Page) -> None:
    for _ in range(int(limits.REQUEST_BURST) + 1):
        page.send("ack", n=0)
    assert (page.page.ended, page.page.refusal) == ([1008], "message_rate")


def test_the_first_message_says_the_time_and_what_the_page_may_do_and_signs_of_life_follow(page: Page) -> None:
    assert Page(Rights(control=True)).hello["may"] == ["control"]
    assert page.hello["at"] == page.now
    page.update(a=1)
    for _ in range(3):
        page.after(page.session.next_timer() - page.now)
        assert page.tick_at == page.now
    assert (page.ticks, len(page.news)) == (3, 1)


def test_a_page_that_takes_nothing_costs_no_processor_time(page: Page) -> None:
    page.send("watch", id=1, topic="/odom", how="value", rate=10)
    page.page.unsent = 1000
    page.message(5)
    page.after(1)
    assert page.session.next_timer() >= page.now + limits.UNSENT_RETRY
    page.page.unsent = 0
    assert page.after(limits.UNSENT_RETRY)[0]["op"] == "value"


def test_a_robot_is_stopped_while_the_page_takes_nothing(page: Page) -> None:
    page.drive(1)
    page.page.unsent = 10_000_000
    assert page.session.next_timer() <= page.now + limits.DRIVE_TIMEOUT
    page.after(limits.DRIVE_TIMEOUT)
    assert page.speeds[-1] == STOP


def test_what_the_hub_cannot_do_is_told_and_the_page_stays(page: Page) -> None:
    page.send("watch", id=1, topic="/odom", how="value")
    page.last("subscribe").failed(RmpaError("no such topic"))
    page.drive(1)
    page.last("advertise").failed(RmpaError("no such type"))
    page.take()
    assert [(each["id"], each["error"]) for each in page.news] == [(1, "no such topic"), (0, "no such type")]
    assert page.page.ended == []


def test_a_fault_of_a_page_s_session_ends_that_page_alone(page: Page) -> None:
    page.send("look", at=[["topic", "/odom"]])
    page.details = None
    page.update(a=1)
    assert page.page.ended == [1011]
