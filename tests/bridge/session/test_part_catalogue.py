"""The catalogue of a part is that of its two plans, for the peer of a session."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

from rmpa.bridge.session.part_catalogue import PartCatalogue

BASE = cast("Any", SimpleNamespace(peer=7))


def test_it_says_what_the_plans_say_of_the_peer() -> None:
    exports = SimpleNamespace(changes=3, pending=True, digest={7: 0xAB}.get)
    imports = SimpleNamespace(held={7: ["/odom"]}.get)
    driver = SimpleNamespace(waits=lambda session: session is BASE)
    made: PartCatalogue[str, object] = PartCatalogue(cast("Any", exports), cast("Any", imports), cast("Any", driver))
    assert (made.changes, made.pending, made.told_digest(BASE)) == (3, True, 0xAB)
    assert (made.held_offers(BASE), made.waits(BASE)) == (["/odom"], True)


def test_telling_again_carries_out_the_first_portion_and_goes_on_with_the_rest() -> None:
    done: list[object] = []
    driver = SimpleNamespace(act=done.extend, schedule=lambda: done.append("the rest"))
    exports = SimpleNamespace(again=lambda peer: [f"first portion to {peer}"])
    made: PartCatalogue[str, object] = PartCatalogue(
        cast("Any", exports), cast("Any", SimpleNamespace()), cast("Any", driver)
    )
    made.tell_again(BASE)
    assert done == ["first portion to 7", "the rest"]
