"""Subscriptions to local publishers, whose routes end with them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

from rmpa.bridge.messages import Source
from rmpa.bridge.topics.exports import ExportRoute
from rmpa.bridge.topics.local import LocalSubscriptions
from rmpa.core.contract import Contract
from rmpa.ros.node.publication import Publication
from tests.bridge.io.doubles import Link
from tests.ros.node.peers import STRING, until

if TYPE_CHECKING:
    from rmpa.bridge.messages import Description

SOURCE = Source("/chatter", "/talker")
URI = "http://talker:1/"


async def test_a_route_that_is_opened_while_the_end_of_the_last_one_is_told_has_data() -> None:
    """The peer that waited for this one may open it while the end of the last one is told."""
    publications = [Publication("/chatter", "/talker", STRING)]
    core = SimpleNamespace(call=lambda *_: None, suspend=None, suspect=lambda _: None)
    node = SimpleNamespace(uri="http://agent:1/", next_number=lambda: 1)
    described: list[Description] = []
    link = Link()

    def lost(source: Source, _reason: str, _lasts: object) -> None:
        publications.append(Publication("/chatter", "/talker", STRING))
        subscriptions.connect(SOURCE, URI)
        subscriptions.add_route(source, 1, ExportRoute(7, Contract(), Contract(), "", ""), cast("Any", link))

    exports = SimpleNamespace(described=lambda _, description: described.append(description), lost=lost)
    shared: Any = SimpleNamespace(core=core, node=node)
    unused = cast("Any", None)
    subscriptions = LocalSubscriptions(shared, cast("Any", exports), unused, unused, lambda *_: publications[-1])
    subscriptions.connect(SOURCE, URI)
    await until(lambda: described)
    publications[0].withdraw()
    await until(lambda: len(described) == 2)
    assert subscriptions.flows[SOURCE].by_peer[1].route == 7
    assert subscriptions.senders[1, 7] is subscriptions.flows[SOURCE].by_peer[1]
    subscriptions.close()
