"""Subscriptions to local publishers, whose routes end with them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

from rmpa.bridge.actions import AddRoute, Connect
from rmpa.bridge.messages import Source
from rmpa.bridge.topics.local import LocalSubscriptions
from rmpa.core.contract import Contract
from rmpa.ros.node.publication import Publication
from tests.bridge.io.doubles import Link
from tests.ros.node.peers import STRING, until

if TYPE_CHECKING:
    from rmpa.bridge.messages import Description

SOURCE = Source("/chatter", "/talker")
CONNECT = Connect(SOURCE, STRING.type, "http://talker:1/")


async def test_a_route_that_is_opened_while_the_end_of_the_last_one_is_told_has_data() -> None:
    """Between the actions of one change others are carried out: an open of the peer that waited for this one."""
    publications = [Publication("/chatter", "/talker", STRING)]
    core = SimpleNamespace(call=lambda *_: None, suspend=None, suspect=lambda _: None)
    node = SimpleNamespace(uri="http://agent:1/", next_number=lambda: 1)
    described: list[Description] = []
    link = Link()

    def lost(source: Source, _reason: str, _lasts: object) -> None:
        publications.append(Publication("/chatter", "/talker", STRING))
        subscriptions.connect(CONNECT)
        subscriptions.add_route(AddRoute(source, 1, 7, Contract()), cast("Any", link))

    subscriptions = LocalSubscriptions(
        cast("Any", core),
        cast("Any", node),
        on_described=lambda _, description: described.append(description),
        on_lost=lost,
        on_given_up=lambda *_: None,
        on_missed=lambda *_: None,
        on_oversized=lambda *_: None,
        on_malformed=lambda *_: None,
        find=lambda *_: publications[-1],
    )
    subscriptions.connect(CONNECT)
    await until(lambda: described)
    publications[0].withdraw()
    await until(lambda: len(described) == 2)
    assert subscriptions.flows[SOURCE].by_peer[1].route == 7
    assert subscriptions.sender(1, 7) is subscriptions.flows[SOURCE].by_peer[1]
    subscriptions.close()
