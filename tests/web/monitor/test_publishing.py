"""What a page publishes: once, at a rate, with the right for it, and never longer than the page is there."""

from __future__ import annotations

import math
import struct
from typing import Any

import pytest

from rmpa.ros.types.codec import codec_for
from rmpa.ros.types.messages import MessageType
from rmpa.web.hub.node_link import Rights
from rmpa.web.monitor import limits
from rmpa.web.monitor.publishing import FieldError, message_of
from tests.web.monitor.test_session import Page

TWIST = "geometry_msgs/Twist"
CONTROL = Rights(view=True, control=True)


def begin(page: Page, rate: float = 0.0, number: int = 1, **more: Any) -> list[Any]:
    about = {"topic": "/cmd", "type": TWIST, "values": {"linear": {"x": 0.5}}, "at": page.now, **more}
    return page.send("publish", id=number, rate=rate, **about)


def published(page: Page) -> list[float]:
    return [struct.unpack("<6d", each)[0] for asked in page.all("advertise") for each in asked.published]


def test_a_message_is_published_once_and_its_topic_is_left() -> None:
    page = Page(CONTROL)
    assert begin(page) == [{"op": "published", "id": 1, "n": 1}]
    assert (published(page), page.last("advertise").closed) == ([0.5], True)
    page.after(5.0)
    assert published(page) == [0.5]


@pytest.mark.parametrize("rights", [Rights(view=True), Rights(view=True, drive=True)])
def test_a_page_without_control_publishes_nothing(rights: Rights) -> None:
    page = Page(rights)
    [refused] = begin(page)
    assert (refused["op"], "only look" in refused["error"]) == ("failed", True)
    assert page.all("advertise") == []


def test_an_order_that_the_network_kept_is_not_carried_out() -> None:
    page = Page(CONTROL)
    [refused] = begin(page, at=page.now - limits.ORDER_AGE - 1)
    assert "late" in refused["error"]
    assert page.all("advertise") == []


def test_at_a_rate_it_goes_on_while_the_page_says_so() -> None:
    page = Page(CONTROL)
    begin(page, rate=2.0)
    for _ in range(3):
        page.advance(1.0)
        page.send("publishing", id=1)
    assert page.news[-1] == {"op": "published", "id": 1, "n": 7}
    page.advance(limits.PUBLISH_RENEW + 1)
    page.take()
    assert "published no more" in page.news[-1]["error"]
    count = len(published(page))
    assert (count, page.last("advertise").closed) == (7 + 2 * limits.PUBLISH_RENEW - 1, True)
    page.advance(5.0)
    assert len(published(page)) == count


@pytest.mark.parametrize("ends", ["unpublish", "the page"])
def test_it_ends_at_once_when_it_is_ended_or_the_page_has_gone(ends: str) -> None:
    page = Page(CONTROL)
    begin(page, rate=10.0)
    if ends == "unpublish":
        page.send("unpublish", id=1)
    else:
        page.session.closing()
    page.advance(2.0)
    assert (published(page), page.last("advertise").closed) == ([0.5], True)


def test_rates_and_topics_are_bounded() -> None:
    page = Page(CONTROL)
    assert "at most 50 messages" in begin(page, rate=limits.PUBLISHED_RATE + 1)[0]["error"]
    for number in range(limits.PUBLISHED_MAX):
        assert begin(page, rate=1.0, number=number + 1)[0]["op"] == "published"
    assert "of 8 topics" in begin(page, rate=1.0, number=99)[0]["error"]


def test_a_wrong_value_names_its_field_and_nothing_is_published() -> None:
    page = Page(CONTROL)
    [refused] = begin(page, values={"linear": {"x": "fast"}})
    assert (refused["field"], refused["error"]) == ("linear.x", "linear.x: is a float64, not 'fast'")
    assert page.all("advertise") == []


def test_values_that_json_has_not_are_text() -> None:
    wide = MessageType("std_msgs/Int64MultiArray")
    now = 5_000_000_007
    raw = message_of(codec_for(wide), {"data": [str(2**63 - 1), "-3", 4]}, now)
    assert struct.unpack("<3q", raw[-24:]) == (2**63 - 1, -3, 4)
    floats = codec_for(MessageType("std_msgs/Float32MultiArray"))
    raw = message_of(floats, {"data": ["nan", "inf", "-inf", None, 1.5]}, now)
    values = struct.unpack("<5f", raw[-20:])
    assert [math.isnan(values[0]), *values[1:3], math.isnan(values[3]), values[4]] == [
        True,
        math.inf,
        -math.inf,
        True,
        1.5,
    ]
    stamped = message_of(codec_for(MessageType("std_msgs/Header")), {"stamp": "now"}, now)
    assert struct.unpack("<3I", stamped[:12]) == (0, 5, 7)
    filled = message_of(codec_for(MessageType("geometry_msgs/PoseStamped")), {}, now)
    assert struct.unpack("<3I", filled[:12]) == (0, 5, 7)


@pytest.mark.parametrize(
    ("kind", "values", "field"),
    [
        ("std_msgs/Int64", {"data": "1e3"}, "data"),
        ("std_msgs/Int32", {"data": "3"}, "data"),
        ("std_msgs/UInt64", {"data": str(2**64)}, "data"),
        ("std_msgs/UInt64", {"data": "9" * 5000}, "data"),
        ("std_msgs/Float64", {"data": "1"}, "data"),
        ("nav_msgs/Path", {"poses": [{}, {"pose": {"position": {"y": []}}}]}, "poses[1].pose.position.y"),
        ("geometry_msgs/Twist", {"speed": 1}, ""),
    ],
)
def test_what_does_not_fit_is_refused_at_its_field(kind: str, values: dict[str, Any], field: str) -> None:
    with pytest.raises(FieldError) as caught:
        message_of(codec_for(MessageType(kind)), values, 0)
    assert caught.value.field == field
