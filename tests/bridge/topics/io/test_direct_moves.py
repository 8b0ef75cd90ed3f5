"""Subscribers that are made to hang up, with doubles for the core and the nodes."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

from rmpa.bridge import limits
from rmpa.bridge.direct.direct_route import DirectKey
from rmpa.bridge.direct.subscriber_side import DirectSubscriptions
from rmpa.bridge.messages import Source
from rmpa.bridge.topics.io import direct_moves
from rmpa.bridge.topics.io.direct_moves import SubscriberMoves
from rmpa.core.counters import Counters
from tests.bridge.io.virtual import VirtualLoop, run

if TYPE_CHECKING:
    import pytest

KEY = DirectKey(1, Source("/chatter", "/talker"), "/viewer")
END = ("10.0.0.1", 45225)


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
