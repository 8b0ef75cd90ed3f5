"""When the offers of a parked peer are fetched again."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

from rmpa.bridge.session.offer_versions import OFFERS, OfferVersions
from rmpa.bridge.session.peer_session import PeerSession, PeerState
from rmpa.core.guid import Guid
from rmpa.core.identity import Identity
from rmpa.core.sizes import UINT32_MAX
from tests.bridge.io.virtual import VirtualLoop, run

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

FAR = Identity(Guid.of("10.0.0.2", 4000), bytes(16), "far")


class Scene:
    """One linked peer, which tells its version over each link before it is parked."""

    def __init__(self) -> None:
        self.links = 0
        link = SimpleNamespace(identity=FAR, guid=FAR.guid, name="far")
        self.session = PeerSession(1, cast("Any", link), cast("Any", None))
        self.versions = OfferVersions(lambda: [self.session], self._want, lambda: 1.0)
        handlers: dict[str, Callable[[PeerSession, dict[str, Any]], None]] = {}
        rpc = SimpleNamespace(on_notification=lambda what, told, _needs: handlers.__setitem__(what, told))
        self.versions.listen(cast("Any", rpc))
        self._told = handlers[OFFERS]

    def hear(self, version: int) -> None:
        self.versions.heard(FAR.guid, FAR.instance, version, 1000)

    def park(self, version: int) -> None:
        self._told(self.session, {"version": version})
        self.session.state = PeerState.PARKED
        self.versions.parked(self.session)

    def _want(self, session: PeerSession) -> None:
        self.links += 1
        session.state = PeerState.LINKED
        self.versions.link_up(session)


def play(scene: Callable[[Scene], Coroutine[object, object, None]]) -> None:
    async def main() -> None:
        made = Scene()
        await scene(made)
        made.versions.close()

    run(main(), VirtualLoop())


def test_newer_offers_of_a_parked_peer_are_fetched_once() -> None:
    async def scene(made: Scene) -> None:
        made.park(3)
        made.hear(3)
        await asyncio.sleep(60)
        assert made.links == 0
        made.hear(4)
        made.hear(5)
        await asyncio.sleep(60)
        assert made.links == 1
        made.park(5)
        await asyncio.sleep(60)
        assert made.links == 1

    play(scene)


def test_a_forged_version_costs_one_link() -> None:
    """Any program that reaches the port of an open mesh can spread it, and it is the highest one there is."""

    async def scene(made: Scene) -> None:
        made.park(3)
        made.hear(UINT32_MAX)
        for _ in range(5):
            await asyncio.sleep(60)
            assert made.links == 1
            if made.session.state is not PeerState.PARKED:
                made.park(3)
        made.hear(4)
        await asyncio.sleep(60)
        assert made.links == 2

    play(scene)
