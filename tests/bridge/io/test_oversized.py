"""Messages that are too long to cross are left out, and that is said at both ends; others go on."""

from __future__ import annotations

import pytest

from rmpa.bridge.data.reception import ImportFlow
from rmpa.bridge.messages import Notification, Source, encode
from rmpa.core.errors import RemoteProtocolError
from rmpa.mesh.frames import Frame, FrameKind
from rmpa.ros import limits
from tests.bridge.io.two_bridges import World, play

BIG = Source("/big", "/one")


def there(world: World) -> ImportFlow:
    """The flow at the receiver."""
    side = world.sides[1]
    (attached,) = side.attached
    entry = side.bridge.topics.imports.get(attached.peer, BIG)
    assert entry is not None
    assert entry.flow is not None
    return entry.flow


def test_both_ends_say_it_and_smaller_ones_go_on(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(limits, "TCPROS_MESSAGE_MAX", 1000)

    async def scene(world: World) -> None:
        a, b = world.sides
        speaker, listener = world.speak(a, "/big", "/one"), world.listen(b, "/big")
        world.link()
        await world.rest(1.0)
        for size in (10, 2000, 1000, 1001, 20):
            speaker.say(size)
            await world.rest(0.2)
        assert [number for _, number in listener.got[speaker.number]] == [1, 3, 5]
        flow = a.bridge.topics.exports.flows[BIG]
        assert (flow.messages, flow.oversized, flow.oversized_bytes) == (3, 2, 1001)
        assert (there(world).oversized, there(world).oversized_bytes, there(world).counts["lost"]) == (2, 1001, 0)
        assert a.bridge.counters["message.oversized"] == b.bridge.counters["message.oversized_there"] == 2
        # A route that is opened again says it again.
        world.leave(listener)
        await world.rest(3.0)
        world.listen(b, "/big")
        await world.rest(1.0)
        speaker.say(5000)
        await world.rest(0.2)
        assert (there(world).oversized, there(world).oversized_bytes) == (1, 5000)

    play(1, scene)
    texts = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert any("/big from /one: a message of 2000 bytes is left out, at most 1000 cross" in text for text in texts)
    assert any("a: /big from /one: its messages of 2000 bytes are too long to cross" in text for text in texts)


@pytest.mark.parametrize(
    "args",
    [
        {},
        {"topic": 1, "node": "/one", "count": 1, "size": 1},
        {"topic": "/big", "node": "/one", "count": -1, "size": 2},
    ],
)
def test_half_of_the_news_is_the_peers_error(args: dict[str, object]) -> None:
    async def scene(world: World) -> None:
        b = world.sides[1]
        world.link()
        await world.rest(0.5)
        assert b.link is not None
        with pytest.raises(RemoteProtocolError):
            b.link.receive(Frame(FrameKind.CONTROL, encode(Notification("message.oversized", args))))
        unknown = {"topic": "/none", "node": "/one", "count": 1, "size": 9}
        b.link.receive(Frame(FrameKind.CONTROL, encode(Notification("message.oversized", unknown))))
        assert b.bridge.counters["message.oversized_there"] == 0

    play(1, scene)
