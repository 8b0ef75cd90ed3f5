"""What a client gets on each error: the table of docs/rosbridge.md, row by row."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from rmpa.core.errors import RmpaError
from rmpa.web import limits
from tests.web.rosbridge.client import Client

if TYPE_CHECKING:
    from collections.abc import Callable

PAGE = Path(__file__).parents[3] / "docs" / "rosbridge.md"
NOTHING = "\N{EN DASH}"
ADD = "rospy_tutorials/AddTwoInts"
_Case = tuple[str, dict[str, Any]]


def _client() -> Client:
    client = Client()
    client.graph.add_topic("/chatter", "std_msgs/String", publishers=("/talker",))
    client.graph.add_service("/add", ADD)
    return client


def _failed(client: Client) -> None:
    (find,) = client.send("call_service", id="i", service="/none")
    find.failed(RmpaError("no server of the service answers"))


def _raised(client: Client) -> None:
    (call,) = client.send("call_service", id="i", service="/add", args=[1, 2])
    call.failed(RmpaError("the server raised"))


def _never_there(client: Client) -> None:
    none, *others = (client.subscribe(topic, id="i") for topic in ("/none", "/soon", "/published"))
    client.graph.add_topic("/soon", "std_msgs/String")
    client.hub.published["/published"] = "std_msgs/String"
    client.advance(limits.TYPE_WAIT - 0.01)
    assert client.received() == []
    client.advance(0.01)
    assert none.closed
    assert not any(each.closed for each in others)


def _other_type_later(client: Client) -> None:
    client.subscribe("/later", id="i", type="std_msgs/Int32").differs("std_msgs/String")


def _offered_elsewhere(client: Client) -> None:
    (made,) = client.send("advertise_service", id="i", service="/s", type=ADD)
    made.failed(RmpaError("another client offers /s now"))


ERRORS: dict[tuple[str, str], tuple[_Case, ...] | Callable[[Client], None]] = {
    ("any", "no JSON, no `op`, an unknown `op`, a field of the op that is missing or of a wrong type"): (
        ("fly", {}),
        ("advertise", {"topic": "/a"}),
        ("publish", {"topic": 7}),
        ("call_service", {}),
        ("set_level", {"level": "loud"}),
        ("fragment", {"data": "x", "num": 5, "total": 2}),
    ),
    ("advertise", "a type that is not known, or another than the topic has"): (
        ("advertise", {"topic": "/a", "type": "no/Such"}),
        ("advertise", {"topic": "/chatter", "type": "std_msgs/Int32"}),
    ),
    ("unadvertise", "a topic that the client does not advertise"): (("unadvertise", {"topic": "/a"}),),
    ("publish", "a topic whose type is not known"): (("publish", {"topic": "/a", "msg": {}}),),
    ("publish", "a field that the type has not, a value that does not fit"): (
        ("publish", {"topic": "/chatter", "msg": {"nope": 1}}),
        ("publish", {"topic": "/chatter", "msg": {"data": 1}}),
    ),
    ("subscribe", "a topic that does not appear within 2 s, without a type"): _never_there,
    ("subscribe", "another type than the topic has"): (
        ("subscribe", {"topic": "/chatter", "type": "std_msgs/Int32"}),
    ),
    ("subscribe", "another type than that of a publisher that comes later"): _other_type_later,
    ("unsubscribe", "a topic that the client is not subscribed to"): (("unsubscribe", {"topic": "/none"}),),
    ("call_service", "a service that is not there"): _failed,
    ("call_service", "arguments that do not fit"): (
        ("call_service", {"service": "/add", "args": {"nope": 1}}),
        ("call_service", {"service": "/add", "args": ["x", 1]}),
    ),
    ("call_service", "the server fails, or does not answer in time"): _raised,
    ("advertise_service", "a type that is not known"): (("advertise_service", {"service": "/s", "type": "no/Such"}),),
    ("advertise_service", "another client offers the service later, and has it from then on"): _offered_elsewhere,
    ("unadvertise_service", "a service that the client does not offer"): (
        ("unadvertise_service", {"service": "/s"}),
    ),
    ("service_response", "no such call is open"): (
        ("service_response", {"service": "/s", "values": {}, "result": True}),
    ),
}


def _rows() -> dict[tuple[str, str], str]:
    text = PAGE.read_text().partition("## Errors\n")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| (?:`(\w+)`|any) \| (.+?) \| (.+?) \| (.+?) \|$", text, re.MULTILINE)
    return {(op or "any", what): here for op, what, _, here in rows if what != "what is wrong"}


def test_the_page_has_each_error() -> None:
    assert _rows().keys() == ERRORS.keys()


@pytest.mark.parametrize("error", ERRORS)
def test_a_client_gets_on_an_error_what_the_page_says(error: tuple[str, str]) -> None:
    cases = ERRORS[error]
    for case in [cases] if callable(cases) else cases:
        client = _client()
        if callable(case):
            case(client)
        else:
            op, values = case
            client.send(op, **values, id="i")
        got = client.received()
        if _rows()[error] == NOTHING:
            assert got == []
            continue
        (frame,) = got  # one, and nothing beside it
        assert f"`{frame['op']}`" == _rows()[error].partition(";")[0]
        if frame["op"] == "status":
            assert frame["level"] == "error"
            assert frame["msg"]
        else:
            assert (frame["result"], frame["id"]) == (False, "i")
            assert isinstance(frame["values"], str)
