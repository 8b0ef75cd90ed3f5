"""The proxies of one peer in made-up time: what becomes of a source's flow, its watch and its subscribers."""

from __future__ import annotations

import asyncio
import inspect
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest

from rmpa.bridge import limits
from rmpa.bridge.data.quality import QosEventKind
from rmpa.bridge.messages import Description, RouteOpened, Source
from rmpa.bridge.sessions import AWAY_GRACE
from rmpa.core.contract import Contract, Durability, Reliability
from rmpa.core.outbox import FIRST
from tests.bridge.io.nodes import MD5, Core, Ear, stages
from tests.bridge.io.proxied import Proxied
from tests.bridge.io.two_bridges import made_up
from tests.bridge.io.virtual import VirtualLoop, run

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from rmpa.bridge.data.reception import ImportFlow
    from rmpa.ros.core.embedded import RosCore
    from rmpa.ros.node.publication import Publication

CMD = Source("/cmd", "/joy")
SURE = Contract(reliability=Reliability.RELIABLE)
ALIVE = Contract(liveliness_lease=5.0)


def lost(flow: ImportFlow) -> int:
    """What the source has lost, over all its flows."""
    return flow.watch.counts[QosEventKind.MESSAGES_LOST]


def framed(text: str, size: int = 0) -> memoryview:
    body = text.encode().ljust(size, b".")
    return memoryview(len(body).to_bytes(4, "little") + body)


class Heard:
    """A local node that listens to one publication."""

    def __init__(self, publication: Publication) -> None:
        self.texts: list[str] = []
        self.ears: dict[Publication, Ear] = {}
        self.ear = self.ears[publication] = Ear(cast("Any", self), publication)
        publication.attach(cast("Any", self.ear))

    def heard(self, _ear: Ear, message: bytes) -> None:
        self.texts.append(message[4:].decode().rstrip("."))

    @property
    def closed(self) -> bool:
        return self.ear.closed


class Scene(Proxied):
    """The source ``/cmd`` in a local graph of its own."""

    def __init__(self) -> None:
        self.named: list[str] = []
        self.core = Core(cast("Any", SimpleNamespace(name="a", named=self.named.append)))
        super().__init__(cast("RosCore", self.core), CMD, "a/B")

    def describe(
        self,
        contract: Contract,
        *,
        route: int = 1,
        epoch: int = 0,
        first: int = 1,
        latching: bool = False,
        definition: str = "",
        **told: Any,
    ) -> ImportFlow:
        about = Description("a/B", MD5, definition, latching)
        return self.opened(RouteOpened(route, about, contract, epoch, first, **told))

    def kinds(self) -> list[QosEventKind]:
        return [kind for _, kind in self.occurred]


def played(scene: Callable[..., Coroutine[object, object, None]]) -> Callable[..., None]:
    """The test that plays a scene in made-up time."""

    async def main(values: dict[str, Any]) -> None:
        proxied = Scene()
        await scene(proxied, **values)
        await proxied.close()
        assert proxied.core.publishers("/cmd") == {}

    def test(**values: Any) -> None:
        loop = VirtualLoop()
        with made_up(loop):
            run(main(values), loop)
        assert not stages

    parameters = list(inspect.signature(scene).parameters.values())
    test.__signature__ = inspect.Signature(parameters[1:])  # type: ignore[attr-defined]
    return test


@played
async def test_the_contract_bounds_the_queue_and_the_latched_messages(proxied: Scene) -> None:
    publication = await proxied.publish()
    proxied.describe(Contract(durability=Durability.TRANSIENT_LOCAL, depth=2), latching=True)
    for number, text in enumerate("abc", 1):
        proxied.flow.message(number, 0, framed(text))
    assert publication._queue_messages == 2
    assert Heard(publication).texts == ["b", "c"]


@played
async def test_subscribers_cut_off_in_a_message_are_called_back_later(proxied: Scene) -> None:
    listener = Heard(await proxied.publish())
    flow = proxied.describe(Contract())
    proxied.named.clear()
    flow.part(1, 0, FIRST, framed("half", 1000)[:500])
    proxied.flow.link_down()
    assert listener.closed
    assert proxied.named == [], "rospy has not noticed yet"
    for delay in limits.CALL_BACK_DELAYS:
        before = len(proxied.named)
        await asyncio.sleep(delay)
        assert len(proxied.named) == before + 1
    await asyncio.sleep(5.0)
    assert proxied.named == ["/cmd"] * len(limits.CALL_BACK_DELAYS)


@played
async def test_a_changed_header_reconnects_the_subscribers(proxied: Scene) -> None:
    publication = await proxied.publish()
    listener = Heard(publication)
    proxied.describe(Contract(), latching=True)
    proxied.flow.message(1, 0, framed("map"))
    proxied.named.clear()
    flow = proxied.describe(Contract(), route=2, latching=True, definition="string data")
    assert listener.closed
    again = Heard(publication)
    flow.message(1, 0, framed("map"))
    assert again.texts == ["map"], "who was hung up on has nothing of what the others had"
    await asyncio.sleep(2.0)
    assert len(proxied.named) == 2


# --- over links that fall -----------------------------------------------------------------------------------------


@played
async def test_a_changed_contract_makes_a_new_flow(proxied: Scene) -> None:
    listener = Heard(await proxied.publish())
    old = proxied.describe(SURE, epoch=5)
    old.message(1, 0, framed("one"))
    proxied.flow.link_down()
    new = proxied.describe(Contract(reliability=Reliability.RELIABLE, depth=7), epoch=6)
    assert new is not old
    new.message(1, 0, framed("two"))
    assert listener.texts == ["one", "two"]
    assert (lost(new), proxied.kinds()) == (0, [QosEventKind.LOSS_UNKNOWN])


# --- what becomes of the contract -----------------------------------------------------------------------------------


@played
async def test_a_missed_deadline_is_said_when_it_is_missed(proxied: Scene) -> None:
    await proxied.publish()
    began = proxied.loop.time()
    flow = proxied.describe(Contract(deadline=1.0))
    await asyncio.sleep(0.9)
    flow.message(1, 0, framed("one"))
    await asyncio.sleep(1.5)
    assert [(round(now - began, 3), kind) for now, kind in proxied.occurred] == [(1.9, QosEventKind.DEADLINE_MISSED)]
    proxied.detach()
    await asyncio.sleep(60.0)
    assert len(proxied.occurred) == 1, "nobody waits for it any more"


@pytest.mark.parametrize("silent", [False, True])
@played
async def test_a_source_that_leaves_with_its_peer_is_lost_at_once(proxied: Scene, silent: bool) -> None:
    await proxied.publish()
    proxied.describe(ALIVE)
    proxied.flow.link_down()
    if silent:
        await asyncio.sleep(AWAY_GRACE)
        assert proxied.occurred == []
    else:
        proxied.detach()
    proxied.route.end(missed=True)
    proxied.route.release()
    assert proxied.kinds() == [QosEventKind.LIVELINESS_LOST]
    await asyncio.sleep(60.0)
    assert len(proxied.occurred) == 1


@played
async def test_all_is_registered_again_that_the_core_has_lost(proxied: Scene) -> None:
    await proxied.publish()
    registered = proxied.core.publishers("/cmd")
    assert not proxied.route.is_missing({"/cmd": dict(registered)})
    assert proxied.route.is_missing({})
    proxied.core.call("unregisterPublisher", "/rmpa/b/joy", "/cmd", registered["/rmpa/b/joy"])
    proxied.route.register()
    assert proxied.core.publishers("/cmd") == registered
