"""How the part for topics or services works off what it has to do."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest

from rmpa.bridge import limits
from rmpa.bridge.graph_part import GraphPart
from rmpa.bridge.messages import Advertise, Source, TopicOffer, decode, encode, op_of
from rmpa.bridge.topics.exports import Exports, LocalSource
from rmpa.bridge.topics.imports import Imports
from rmpa.core.counters import Counters
from rmpa.core.errors import LimitExceeded
from tests.bridge.recorder import context

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rmpa.bridge.sessions import PeerSession

LOCAL = LocalSource("a/B", "http://x:1/")


class Part(GraphPart):
    """Topics of one linked peer, without a graph."""

    verb = "publishes"
    imports: Imports
    exports: Exports

    def __init__(self) -> None:
        self.sent: list[Any] = []
        self.shown: list[str] = []
        self.failing: set[str] = set()
        self.settled = 0
        link = SimpleNamespace(
            name="far", busy=False, remote_endpoint=("x", 1), send_control=lambda data: self.sent.append(decode(data))
        )
        link.abort = self.sent.append
        self.session = cast("PeerSession", SimpleNamespace(peer=1, link=link, linked=True))
        shared = SimpleNamespace(counters=Counters(), rng=lambda: 0.5, context=context(), sessions={1: self.session})
        super().__init__(cast("Any", shared), Exports, Imports)
        self.imports.link_up(1, "far")
        self.exports.link_up(1, "far")

    def _look_at(self, name: str) -> None:
        if name in self.failing:
            raise RuntimeError("once")
        self.exports.put(Source(name, "/n"), LOCAL)

    def _names(self) -> Iterable[str]:
        return ()

    def _settled(self) -> None:
        self.settled += 1

    def publish(self, entry: Any) -> None:
        """Note what is shown."""
        self.shown.append(entry.name)


async def until_settled(part: Part) -> None:
    while not part.settled:
        await asyncio.sleep(0)


async def test_names_are_looked_at_and_told_in_slices_and_a_failing_one_holds_up_no_other(
    caplog: pytest.LogCaptureFixture,
) -> None:
    part = Part()
    names = [f"/t{number}" for number in range(3 * limits.RESCANNED_AT_ONCE)]
    part.failing = {names[3]}
    part.look(names)
    assert not part.idle
    await until_settled(part)
    told = [offer.topic for message in part.sent for offer in message.added]
    assert told == [name for name in names if name != names[3]]
    assert "once" in caplog.text


async def test_advertisements_are_applied_in_order_and_too_many_bytes_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    part = Part()
    names = [f"/t{number}" for number in range(2 * limits.APPLIED_AT_ONCE)]
    for begin in range(0, len(names), 8):
        offers = tuple(TopicOffer(name, "/n", "a/B") for name in names[begin : begin + 8])
        part.advertised(part.session, encode(Advertise(offers)))
    assert not part.shown
    assert part.depends(part.session)
    monkeypatch.setattr(limits, "ADVERTISED_WAITING_BYTES", 0)
    part.advertised(part.session, encode(Advertise(removed=(Source("/t0", "/n"),))))
    assert part.shown == names[: len(part.shown)]
    assert len(part.shown) >= len(names) - 8
    await until_settled(part)
    assert part.shown == names
    assert part.imports.get(1, Source("/t0", "/n")) is None
    assert not part.depends(part.session)


async def test_a_peer_that_sends_nonsense_for_an_advertisement_loses_its_link() -> None:
    part = Part()
    part.advertised(part.session, b'{"op": "advertise", "added": 7}')
    await until_settled(part)
    assert "broke the protocol" in part.sent[-1]


async def test_what_a_lost_link_has_said_is_dropped() -> None:
    part = Part()
    part.direct_imports = part.direct_exports = cast("Any", SimpleNamespace(link_down=lambda _: None))
    part.advertised(part.session, encode(Advertise((TopicOffer("/t", "/n", "a/B"),))))
    part.link_down(part.session)
    assert not part.depends(part.session)
    await until_settled(part)
    assert not part.shown


async def test_a_too_long_advertisement_ends_the_link_unparsed() -> None:
    part = Part()
    payload = encode(Advertise()).replace(b"[]", b" " * limits.ADVERTISEMENT_MAX + b"[]", 1)
    assert op_of(payload) == "advertise"
    with pytest.raises(LimitExceeded):
        part.advertised(part.session, payload)
