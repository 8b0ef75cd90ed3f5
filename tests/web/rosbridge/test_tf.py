"""tf2_web_republisher without the node: its service, its action in both forms, rates and thresholds."""

from __future__ import annotations

from typing import Any

import pytest

from rmpa.web.hub.node_link import READ_ONLY
from rmpa.web.hub.transforms import Transform
from rmpa.web.rosbridge import limits
from tests.web.hub.test_transforms import message, row, turned
from tests.web.rosbridge.client import Client

WANTED = {"source_frames": ["base"], "target_frame": "/map", "angular_thres": 0.1, "trans_thres": 0.1, "rate": 10.0}
ACTION = "/tf2_web_republisher"


def moves(client: Client, place: Transform, child: str = "base") -> None:
    client.hub.shared["/tf"](message(row("map", child, place)))


def transforms(client: Client, seconds: float = 0.1) -> list[Any]:
    """What comes within some time: the transforms of each message, whichever its form."""
    client.advance(seconds)
    found = []
    for got in client.received():
        body = got["values"] if got["op"] == "action_feedback" else got["msg"].get("feedback", got["msg"])
        found.append(body["transforms"])
    return found


def begin(client: Client, way: str) -> None:
    """Ask for transforms in one of the ways of clients."""
    client.session.rights = READ_ONLY  # it is reading
    if way == "service":
        client.send("call_service", service="/republish_tfs", id="1", args=WANTED | {"timeout": {"secs": 2}})
        (answer,) = client.received()
        client.send("subscribe", topic=answer["values"]["topic_name"], type="tf2_web_republisher/TFArray")
    elif way == "actionlib":
        for topic in ("goal", "cancel"):
            client.send("advertise", topic=f"{ACTION}/{topic}", type="tf2_web_republisher/TFSubscriptionActionGoal")
        client.send("subscribe", topic=f"{ACTION}/feedback", type="tf2_web_republisher/TFSubscriptionActionFeedback")
        client.send("publish", topic=f"{ACTION}/goal", msg={"goal_id": {"id": "g"}, "goal": WANTED})
    else:
        client.send("send_action_goal", id="g", action=ACTION, action_type="x/Y", args=WANTED, feedback=True)
    assert client.received() == []
    assert client.asked == [], "nothing of it is in the ROS graph"


@pytest.mark.parametrize("way", ["service", "actionlib", "action"])
def test_a_client_gets_what_has_moved_no_faster_than_its_rate(client: Client, way: str) -> None:
    begin(client, way)
    assert transforms(client) == []  # the frame is not there
    moves(client, turned(0.0, 1.0))
    ((first,),) = transforms(client)
    assert (first["header"]["frame_id"], first["child_frame_id"]) == ("map", "base")
    assert first["header"]["stamp"]["secs"] > 0
    assert first["transform"]["translation"]["x"] == 1.0
    moves(client, turned(0.05, 1.05))
    assert transforms(client, 1.0) == []
    moves(client, turned(0.2, 1.05))
    assert len(transforms(client, 1.0)) == 1
    for number in range(100):
        moves(client, turned(0.0, float(number)))
        client.advance(0.01)
    assert 9 <= len(transforms(client, 0)) <= 11


def test_a_threshold_of_zero_sends_all(client: Client) -> None:
    client.send("send_action_goal", id="g", action=ACTION, args=WANTED | {"trans_thres": 0.0})
    moves(client, turned(0.0))
    assert len(transforms(client, 1.0)) >= 9


def test_a_cancelled_goal_has_a_result_and_nothing_follows(client: Client) -> None:
    begin(client, "actionlib")
    for topic, kind in (("status", "actionlib_msgs/GoalStatusArray"), ("result", "")):
        client.send("subscribe", topic=f"{ACTION}/{topic}", **({"type": kind} if kind else {}))
    client.send("publish", topic=f"{ACTION}/cancel", msg={"id": "g"})
    status, result = client.received()
    assert [each["status"] for each in status["msg"]["status_list"]] == [2]
    assert (result["msg"]["status"]["goal_id"]["id"], result["msg"]["status"]["status"]) == ("g", 2)
    assert client.session._tf.next_timer() is None
    assert client.hub.shared == {}, "nothing is subscribed to any more"
    begin(client, "action")
    client.send("cancel_action_goal", id="g", action=ACTION)
    (ended,) = client.received()
    assert (ended["op"], ended["id"], ended["status"]) == ("action_result", "g", 5)
    assert client.hub.shared == {}


def test_a_topic_without_a_subscriber_ends_after_its_timeout(client: Client) -> None:
    begin(client, "service")
    client.advance(10.0)
    assert "/tf" in client.hub.shared
    client.send("unsubscribe", topic=f"{ACTION}/tf_repub_0")
    client.advance(1.9)
    assert "/tf" in client.hub.shared
    client.advance(0.3)
    assert client.hub.shared == {}


def test_a_client_that_has_gone_leaves_nothing(client: Client) -> None:
    begin(client, "actionlib")
    client.session.closing()
    assert client.hub.shared == {}


def test_a_real_node_goes_first(client: Client) -> None:
    client.graph.add_service("/republish_tfs", "tf2_web_republisher/RepublishTFs")
    client.graph.add_topic(
        f"{ACTION}/feedback", "tf2_web_republisher/TFSubscriptionActionFeedback", publishers=("/real",)
    )
    client.send("call_service", service="/republish_tfs", args=WANTED)
    client.send("subscribe", topic=f"{ACTION}/feedback")
    client.send("advertise", topic=f"{ACTION}/goal", type="tf2_web_republisher/TFSubscriptionActionGoal")
    assert [each.what for each in client.asked] == ["call", "subscribe", "advertise"]


def test_what_is_asked_for_is_bounded_and_checked(client: Client) -> None:
    client.send("send_action_goal", id=1, action="/fibonacci", args={})
    assert "'/fibonacci' is not one of rosbridge's own messages here" in client.error()
    client.send("send_action_goal", id=1, action=ACTION, args={"source_frames": 7})
    assert "source_frames" in client.error()
    client.send("send_action_goal", id=1, action=ACTION, args={"source_frames": ["f"] * (limits.TF_FRAMES_MAX + 1)})
    assert "source frames are more than" in client.error()
    for number in range(limits.TF_REQUESTS_MAX):
        client.send("send_action_goal", id=number, action=ACTION, args=WANTED | {"rate": 1e9})
    assert client.received() == []
    client.send("send_action_goal", id=1000, action=ACTION, args=WANTED)
    assert "requests for transforms already" in client.error()
    moves(client, turned(0.0))
    client.advance(0.001)
    assert len(client.received()) == limits.TF_REQUESTS_MAX
    moves(client, turned(0.0, 9.0))
    client.advance(0.9 / limits.TF_RATE_MAX)
    assert client.received() == []
