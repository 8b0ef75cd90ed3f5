"""Subscribers that are made to hang up, with doubles for the core and the nodes."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

from rmpa.bridge import limits
from rmpa.bridge.direct.conditions import Grant
from rmpa.bridge.direct.direct_route import Ask, DirectKey, Move
from rmpa.bridge.direct.io import nodes
from rmpa.bridge.direct.subscriber_side import DirectSubscriptions
from rmpa.bridge.messages import Source
from rmpa.bridge.topics.io import direct_moves
from rmpa.bridge.topics.io.direct_moves import SubscriberMoves
from rmpa.core.contract import Transport
from rmpa.core.counters import Counters
from rmpa.ros.wire.bus import BusLink
from tests.bridge.io.virtual import VirtualLoop, run

if TYPE_CHECKING:
    import pytest

KEY = DirectKey(1, Source("/chatter", "/talker"), "/viewer")
END = ("10.0.0.1", 45225)
PROXY = "http://10.0.0.2:9/"


def test_a_subscriber_gets_the_list_once_more_after_its_last_hang_up_and_none_after_the_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    loop, lists = VirtualLoop(), []

    async def links(*_: object) -> list[object]:
        return []

    async def ended(*_: object) -> str:
        return ""

    async def update(_uri: str, topic: str, _publishers: list[str]) -> None:
        lists.append((topic, loop.time()))

    monkeypatch.setattr(direct_moves, "direct_links", links)
    monkeypatch.setattr(direct_moves, "end_links", ended)
    monkeypatch.setattr(direct_moves, "publisher_update", update)
    core = SimpleNamespace(subscribers=lambda _: {"/viewer": "http://10.0.0.2:1/"}, publishers=lambda _: {})

    async def main() -> None:
        moves = SubscriberMoves(
            cast("Any", core),
            cast("Any", SimpleNamespace()),
            {},
            cast("Any", SimpleNamespace(get=lambda _: None)),
            DirectSubscriptions(),
            on_demand=lambda *_: None,
            on_left=lambda _: None,
            on_warning=lambda *_: None,
            counters=Counters(),
        )
        moves.hang_up(KEY, END)
        await asyncio.sleep(1.0)
        moves.hang_up(KEY, END)
        await asyncio.sleep(2 * limits.DIRECT_LIST_AGAIN)
        begin = lists[0][1]
        assert [at - begin for _, at in lists] == [0.0, 1.0, 1.0 + limits.DIRECT_LIST_AGAIN]
        moves.hang_up(KEY, END)
        moves.hang_up(KEY, END)
        await asyncio.sleep(1.0)
        lists.clear()
        await moves.close()
        await asyncio.sleep(2 * limits.DIRECT_LIST_AGAIN)
        assert not lists

    run(main(), loop)


def test_a_subscriber_is_called_back_once_it_has_forgotten_the_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    """rospy takes no notice of a publisher that it still has a connection of, and came back 2 s later."""
    loop, done = VirtualLoop(), []
    rows = [[BusLink(1, PROXY, True, "/chatter", True, None, None)]] * 3 + [[]]

    async def bus(_uri: str) -> list[BusLink]:
        done.append("asked")
        return rows.pop(0)

    async def update(_uri: str, _topic: str, publishers: list[str]) -> None:
        done.append("called back" if publishers else "left")
        if publishers:
            routes.answered(KEY, END, loop.time())

    monkeypatch.setattr(nodes, "bus_links", bus)
    monkeypatch.setattr(direct_moves, "publisher_update", update)
    monkeypatch.setattr(direct_moves, "standing", lambda _: {1})
    routes = DirectSubscriptions(is_relayed=lambda _: True)
    (ask,) = routes.consider(KEY, Transport.AUTO, None, 0.0)
    assert isinstance(ask, Ask)
    grant = Grant(END[1], "/talker")
    routes.replied(KEY, ask.attempt, grant, 0.0)
    assert Move(KEY) in routes.probed(1, END[1], "", 0.0)
    publication = SimpleNamespace(
        topic="/chatter", callers=frozenset(), subscribers=0, hang_up=lambda _: True, spare=lambda *_: None
    )
    core = SimpleNamespace(
        subscribers=lambda _: {"/viewer": "http://10.0.0.2:1/"}, publishers=lambda _: {"/rmpa/a/talker": PROXY}
    )
    session = SimpleNamespace(
        address=END[0],
        proxies=SimpleNamespace(get=lambda _: SimpleNamespace(uri=PROXY)),
        link=SimpleNamespace(name="a"),
    )

    async def main() -> None:
        moves = SubscriberMoves(
            cast("Any", core),
            cast("Any", SimpleNamespace(get=lambda *_: SimpleNamespace(topic="/chatter"))),
            cast("Any", {1: SimpleNamespace(publication=lambda _: publication)}),
            cast("Any", SimpleNamespace(get=lambda _: session)),
            routes,
            on_demand=lambda *_: None,
            on_left=lambda _: done.append("interrupted"),
            on_warning=lambda *_: None,
            counters=Counters(),
        )
        moves.move(KEY)
        await asyncio.sleep(1.0)
        await moves.close()

    run(main(), loop)
    assert done == ["left", "asked", "asked", "asked", "asked", "interrupted", "called back"]
