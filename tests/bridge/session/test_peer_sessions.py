"""When a session begins, waits for its peer, goes on and ends."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest

from rmpa.bridge.policy import PermissionGate
from rmpa.bridge.sessions import Part, PeerSession, PeerSessions, PeerState
from rmpa.config.settings import TrustSettings
from rmpa.core.identity import Guid, Identity
from rmpa.mesh import limits as mesh_limits
from rmpa.trust.permissions import Permissions
from tests.bridge.io.virtual import VirtualLoop, run

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Sequence

    from rmpa.mesh.io.link import PeerLink
    from rmpa.ros.wire.xmlrpc import RosReply

GRACE = mesh_limits.SILENT_GRACE


class Keeper(Part):
    """Notes what it is told, and keeps something for each of these seconds."""

    def __init__(self, *outages: float) -> None:
        self.outages = outages
        self.told: list[str] = []

    def link_up(self, session: PeerSession) -> None:
        self.told.append(f"up {session.peer}")

    def link_down(self, session: PeerSession) -> None:
        self.told.append("down")

    def grace_over(self, session: PeerSession) -> bool:
        self.told.append("grace over")
        return bool(self.outages)

    def outlasted(self, session: PeerSession, seconds: float) -> float | None:
        return min((outage for outage in self.outages if outage > seconds), default=None)

    def gone(self, session: PeerSession) -> None:
        self.told.append("gone")


class Link:
    """What a session needs of a link to a run of the peer."""

    name = "far"
    resumed_at = 0.0
    abandoned = False

    def __init__(self, run_number: int, *, silent: bool, host: str = "10.0.0.1") -> None:
        self.identity = Identity(Guid.of(host, 1000), bytes([run_number]) * 16, self.name)
        self.guid = self.identity.guid
        self.routes: dict[int, object] = {}
        self.silent = silent
        self.crashed = False


class Scene:
    """The sessions of one bridge with one part."""

    def __init__(self, *outages: float, before: Sequence[Part] = ()) -> None:
        self.part = Keeper(*outages)
        nodes = cast("Any", SimpleNamespace())
        self.gate = PermissionGate()
        self.sessions = PeerSessions([*before, self.part], nodes, self._killed, self.gate)

    async def _killed(self, *_: object) -> RosReply:
        raise NotImplementedError

    def link(self, run_number: int = 1, *, silent: bool = True, host: str = "10.0.0.1") -> PeerLink:
        link = cast("PeerLink", Link(run_number, silent=silent, host=host))
        self.sessions.link_up(link)
        return link

    def states(self) -> list[PeerState]:
        return [session.state for session in self.sessions]


def play(scene: Callable[[Scene], Coroutine[object, object, None]], *outages: float) -> list[str]:
    """Play a scene; return what the part was told."""
    loop, told = VirtualLoop(), []

    async def main() -> None:
        made = Scene(*outages)
        await scene(made)
        told.extend(made.part.told)
        await made.sessions.close()
        assert made.states() == []

    run(main(), loop)
    return told


def test_a_short_silence_goes_unnoticed() -> None:
    async def scene(made: Scene) -> None:
        made.sessions.link_down(made.link())
        assert made.states() == [PeerState.SILENT]
        await asyncio.sleep(GRACE / 2)
        made.link()
        await asyncio.sleep(GRACE)
        assert made.states() == [PeerState.LINKED]

    assert play(scene) == ["up 1", "down", "up 1"]


class Broken(Part):
    """A part that fails whatever it is told."""

    def link_up(self, session: PeerSession) -> None:
        raise ZeroDivisionError

    link_down = gone = lane_lost = link_up

    def grace_over(self, session: PeerSession) -> bool:
        raise ZeroDivisionError


def test_a_part_that_fails_does_not_keep_the_next_ones_from_being_told(caplog: pytest.LogCaptureFixture) -> None:
    made: list[Scene] = []

    async def main() -> None:
        made.append(Scene(before=[Broken()]))
        made[0].sessions.link_down(made[0].link())
        await asyncio.sleep(GRACE * 2)
        await made[0].sessions.close()

    run(main(), VirtualLoop())
    assert made[0].part.told == ["up 1", "down", "grace over", "gone"]
    assert "Broken failed" in caplog.text


def test_another_module_that_claims_a_run_does_not_get_its_session() -> None:
    """Instances are no secret: each member hears them in beacons. In a secured mesh the name alone is proved."""

    async def scene(made: Scene) -> None:
        made.sessions.link_down(made.link())
        thief = Link(1, silent=True)
        thief.name = "thief"
        thief.identity = Identity(thief.guid, thief.identity.instance, "thief")
        made.sessions.link_up(cast("PeerLink", thief))
        assert [(session.peer, session.link.name) for session in made.sessions] == [(2, "thief")]

    assert play(scene) == ["up 1", "down", "gone", "up 2"]


@pytest.mark.parametrize("secured", [True, False])
def test_a_module_at_the_address_of_another_ends_its_session_in_a_plain_mesh_alone(*, secured: bool) -> None:
    """In a secured mesh the address is a claim, and the name is proved. In a plain one the module was renamed."""

    async def scene(made: Scene) -> None:
        made.gate.permissions = Permissions(TrustSettings()) if secured else None
        made.sessions.link_down(made.link())
        other = Link(2, silent=True)
        other.name = "other"
        other.identity = Identity(other.guid, other.identity.instance, "other")
        made.sessions.link_up(cast("PeerLink", other))
        assert [session.link.name for session in made.sessions] == (["far"] if secured else []) + ["other"]

    assert play(scene) == ["up 1", "down", *([] if secured else ["gone"]), "up 2"]


def test_a_session_that_nothing_waits_for_ends_after_the_grace() -> None:
    async def scene(made: Scene) -> None:
        made.sessions.link_down(made.link())
        await asyncio.sleep(GRACE + 0.1)
        assert made.states() == []
        made.link()

    assert play(scene) == ["up 1", "down", "grace over", "gone", "up 2"]


def test_a_peer_whose_agent_died_has_a_short_grace() -> None:
    async def scene(made: Scene) -> None:
        link = made.link()
        link.crashed = True
        made.sessions.link_down(link)
        await asyncio.sleep(mesh_limits.AWAY_GRACE / 2)
        assert made.states() == [PeerState.SILENT]
        await asyncio.sleep(mesh_limits.AWAY_GRACE)
        assert made.states() == []

    assert play(scene) == ["up 1", "down", "grace over", "gone"]


def test_a_link_that_was_closed_in_order_has_no_grace() -> None:
    async def scene(made: Scene) -> None:
        made.sessions.link_down(made.link(silent=False))
        assert made.states() == []

    assert play(scene) == ["up 1", "down", "grace over", "gone"]


def test_a_session_waits_for_as_long_as_something_is_kept() -> None:
    async def scene(made: Scene) -> None:
        made.sessions.link_down(made.link())
        await asyncio.sleep(8.9)
        assert made.states() == [PeerState.AWAY]
        await asyncio.sleep(0.2)
        assert made.states() == []

    assert play(scene, 3.0, 9.0) == ["up 1", "down", "grace over", "gone"]


def test_another_run_of_the_peer_ends_the_session_that_waits() -> None:
    async def scene(made: Scene) -> None:
        made.sessions.link_down(made.link(1))
        await asyncio.sleep(GRACE + 1.0)
        link = made.link(2)
        assert made.states() == [PeerState.LINKED]
        [session] = made.sessions.linked()
        assert made.sessions.of(link) is session
        assert made.sessions.get(1) is None

    assert play(scene, 9.0) == ["up 1", "down", "grace over", "gone", "up 2"]
