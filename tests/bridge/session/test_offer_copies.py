"""Copies of peers' offers: when they are compared, when they are fetched again, and what a hello says of them."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

import pytest

from rmpa.bridge import limits
from rmpa.bridge.catalogue.digest import HeldOffers, digest_of, digest_text
from rmpa.bridge.session.offer_copies import OfferCopies
from rmpa.bridge.session.offer_versions import OfferVersions
from rmpa.bridge.session.peer_session import OfferCopy, PeerState
from rmpa.core.errors import RemoteProtocolError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rmpa.bridge.permission_gate import Needs
    from rmpa.bridge.session.peer_session import PeerSession

INSTANCE = bytes(range(16))
OFFERS = {"topics": ["/a", "/b"], "services": ["/s"]}


class Catalogue:
    """A kind of offers, of this module and of its peers."""

    def __init__(self, offers: Sequence[str]) -> None:
        self.held: list[str] | None = list(offers)
        self.changes = 1
        self.pending = self.waiting = False
        self.asked = 0
        self.again = 0

    def told_digest(self, _session: PeerSession) -> int | None:
        return None if self.pending else digest_of(["/mine"])

    def held_offers(self, _session: PeerSession) -> list[str] | None:
        self.asked += 1
        return self.held

    def waits(self, _session: PeerSession) -> bool:
        return self.waiting

    def tell_again(self, _session: PeerSession) -> None:
        self.again += 1


def make_session(peer: int = 1, state: PeerState = PeerState.LINKED) -> PeerSession:
    identity = SimpleNamespace(instance=INSTANCE)
    link = SimpleNamespace(identity=identity, name=f"peer{peer}", guid=peer)
    made = SimpleNamespace(
        peer=peer,
        state=state,
        copy=OfferCopy(),
        link=link,
        offers_held=3,
        offers_told=None,
        compares=True,
        linked=True,
    )
    return cast("PeerSession", made)


def say(copies: OfferCopies, session: PeerSession, **offers: list[str]) -> None:
    right = OFFERS | offers
    copies.said(session, digest_of(right["topics"]), digest_of(right["services"]))


class World:
    """Copies, and what was done about them; the clock stands still but for ``after``."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.catalogues = [Catalogue(OFFERS["topics"]), Catalogue(OFFERS["services"])]
        self.differed: list[int] = []
        self.fetched: list[int] = []
        self.copies = OfferCopies(
            self.catalogues,
            lambda session: self.fetched.append(session.peer),
            lambda session: self.differed.append(session.peer),
        )
        self._shift = 0.0
        loop = asyncio.get_running_loop()
        began = loop.time()
        monkeypatch.setattr(loop, "time", lambda: began + self._shift)

    def after(self, seconds: float) -> None:
        """Compare, so much later."""
        self._shift += seconds
        self.copies.compare()


@pytest.fixture
async def world(monkeypatch: pytest.MonkeyPatch) -> World:
    return World(monkeypatch)


async def test_a_copy_that_is_right_is_compared_once_after_a_change(world: World) -> None:
    session = make_session()
    world.copies.compare()
    assert world.catalogues[0].asked == 0
    say(world.copies, session)
    world.copies.compare()
    assert (session.copy.right, world.fetched, session.copy.differed) == (True, [], 0)
    assert world.copies.held(session) == HeldOffers.of(
        INSTANCE, 3, digest_of(OFFERS["topics"]), digest_of(OFFERS["services"])
    )


@pytest.mark.parametrize("kind", ["topics", "services"])
@pytest.mark.parametrize("state", [PeerState.LINKED, PeerState.PARKED])
async def test_a_copy_that_differs_is_fetched_again(world: World, kind: str, state: PeerState) -> None:
    session = make_session(state=state)
    say(world.copies, session, **{kind: ["/else"]})
    world.copies.compare()
    assert (session.copy.right, world.fetched, world.differed) == (False, [1], [1])
    assert world.copies.held(session) is None
    world.copies.advertised(session)
    assert session.copy.right is False, "until it is known to be right"
    say(world.copies, session)
    world.after(limits.REFETCH_PAUSE + 1)
    assert (session.copy.right, session.copy.differed, session.copy.in_a_row) == (True, 1, 0)


async def test_a_lasting_difference_is_fetched_ever_more_rarely(world: World) -> None:
    session = make_session()
    say(world.copies, session, topics=["/else"])
    pauses = []
    for _ in range(12):
        began = world._shift
        count = len(world.fetched)
        while len(world.fetched) == count:
            world.after(1.0)
        pauses.append(world._shift - began)
    assert pauses[1:8] == pytest.approx([5.0, 10.0, 20.0, 40.0, 80.0, 160.0, 320.0])
    assert max(pauses) == pytest.approx(limits.REFETCH_PAUSE_MAX)


async def test_a_copy_is_not_compared_while_it_changes_or_its_peer_is_away(world: World) -> None:
    session = make_session()
    say(world.copies, session, topics=["/else"])
    world.catalogues[1].waiting = True
    world.copies.compare()
    world.catalogues[1].waiting = False
    for state in (PeerState.SILENT, PeerState.WANTED, PeerState.AWAY):
        session.state = state
        world.copies.compare()
    assert (world.fetched, session.copy.right) == ([], None)
    session.state = PeerState.LINKED
    world.copies.advertised(session)
    world.copies.compare()
    assert world.fetched == [], "the digests were those before this advertisement"


async def test_a_copy_that_is_not_whole_is_not_compared(world: World) -> None:
    session = make_session()
    world.catalogues[0].held = None
    say(world.copies, session)
    world.copies.compare()
    assert (session.copy.right, world.fetched, world.copies.held(session)) == (None, [], None)


async def test_an_error_that_comes_later_is_found_in_turn(world: World) -> None:
    sessions = [make_session(peer) for peer in range(limits.AUDITED_AT_ONCE)]
    for session in sessions:
        say(world.copies, session)
    world.copies.compare()
    world.catalogues[0].asked = 0
    world.copies.compare()
    some = world.catalogues[0].asked
    assert 0 < some < len(sessions), "a bounded number each time"
    world.catalogues[0].held = ["/a"]
    for _ in range(limits.AUDITED_AT_ONCE):
        world.copies.compare()
    assert sorted(world.fetched) == list(range(limits.AUDITED_AT_ONCE)), "each of them once"


async def test_many_differences_are_fetched_a_few_at_a_time(world: World) -> None:
    for peer in range(limits.REFETCHED_AT_ONCE + 1):
        say(world.copies, make_session(peer), topics=["/else"])
    world.copies.compare()
    assert len(world.fetched) == limits.REFETCHED_AT_ONCE
    world.copies.compare()
    assert len(world.fetched) == limits.REFETCHED_AT_ONCE + 1


async def test_a_peer_that_is_gone_is_not_compared(world: World) -> None:
    session, other = make_session(1), make_session(2)
    say(world.copies, session, topics=["/else"])
    say(world.copies, other)
    world.copies.compare()
    for one in (session, other):
        world.copies.forget(one)
    world.after(100.0)
    assert (world.fetched, world.copies.held(other)) == ([1], None)


@pytest.mark.parametrize("state", [PeerState.LINKED, PeerState.PARKED, PeerState.SILENT, PeerState.AWAY])
async def test_what_is_held_after_a_link_is_said_unless_it_was_dropped(world: World, state: PeerState) -> None:
    session = make_session()
    say(world.copies, session)
    world.copies.compare()
    session.state = state
    assert (world.copies.held(session) is None) == (state is PeerState.AWAY)


# --- versions and digests over links -----------------------------------------------------------------------------


class Rpc:
    """Takes what is sent."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, dict[str, object]]] = []
        self.listeners: dict[str, Callable[[PeerSession, dict[str, object]], None]] = {}

    def on_notification(
        self, what: str, listener: Callable[[PeerSession, dict[str, object]], None], _needs: Needs
    ) -> None:
        self.listeners[what] = listener

    def notify(self, _session: PeerSession, what: str, args: dict[str, object]) -> None:
        self.sent.append((what, args))


class Versions:
    """One side's versions, with one peer."""

    def __init__(self) -> None:
        self.session, self.rpc, self.counted = make_session(), Rpc(), list[str]()
        self.wanted: list[int] = []
        self.offers = OfferVersions(
            lambda: [self.session], lambda session: self.wanted.append(session.peer), lambda: 0.5
        )
        self.catalogues = [Catalogue(OFFERS["topics"]), Catalogue(OFFERS["services"])]
        for catalogue in self.catalogues:
            self.offers.add(catalogue)
        refusals = SimpleNamespace(
            refuse=lambda _now, name, _who, _text: self.counted.append(name), count=self.counted.append
        )
        self.offers.listen(self.rpc, refusals)  # type: ignore[arg-type] # doubles
        self.offers.instance = INSTANCE

    def hear(self, what: str, **args: object) -> None:
        self.rpc.listeners[what](self.session, args)


async def test_a_peer_is_told_version_and_digests_when_it_has_all() -> None:
    made = Versions()
    made.catalogues[0].pending = True
    made.offers.settled(lambda _: False)
    assert made.rpc.sent == []
    made.catalogues[0].pending = False
    made.offers.settled(lambda _: False)
    made.offers.settled(lambda _: False)
    mine = digest_text(digest_of(["/mine"]))
    assert made.rpc.sent == [("offers", {"version": 3, "topics": mine, "services": mine})]


async def test_a_peer_of_an_earlier_release_is_told_the_version_alone_and_only_for_parking() -> None:
    made = Versions()
    made.session.compares = False
    made.offers.settled(lambda _: False)
    assert made.rpc.sent == []
    made.offers.settled(lambda _: True)
    assert made.rpc.sent == [("offers", {"version": 3})]
    made.hear("offers", version=7)
    made.offers.settled(lambda _: True)
    assert (made.session.offers_held, made.session.copy.right) == (7, None)


async def test_a_linked_peer_is_asked_for_its_offers_and_a_parked_one_is_linked() -> None:
    made = Versions()
    wrong = {"version": 7, "topics": "0" * 16, "services": "0" * 16}
    made.hear("offers", **wrong)
    made.offers.settled(lambda _: False)
    assert made.rpc.sent[0] == ("offers.again", {"version": 7})
    assert (made.counted, made.wanted) == (["offers.differed"], [])
    parked = Versions()
    parked.session.state = PeerState.PARKED
    parked.session.linked = False  # type: ignore[misc] # a double
    parked.hear("offers", **wrong)
    parked.offers.settled(lambda _: False)
    assert (parked.rpc.sent, parked.wanted) == ([], [1])


async def test_a_peer_that_asks_is_sent_both_catalogues_once_in_a_while() -> None:
    made = Versions()
    made.offers.settled(lambda _: False)
    made.rpc.sent.clear()
    for _ in range(3):
        made.hear("offers.again", version=3)
    assert [catalogue.again for catalogue in made.catalogues] == [1, 1]
    assert made.counted == ["offers.sent_again"]
    made.offers.settled(lambda _: False)
    assert [what for what, _ in made.rpc.sent] == ["offers"], "it is told the version again behind them"


@pytest.mark.parametrize(
    "args",
    [
        {},
        {"version": 0},
        {"version": "1"},
        {"version": 1 << 32},
        {"version": 1, "topics": 5, "services": "0" * 16},
        {"version": 1, "topics": "0" * 16, "services": "0" * 15},
        {"version": 1, "topics": None},
        {"version": 1, "topics": ["0" * 16] * 1000, "services": "0" * 16},
    ],
)
async def test_malformed_versions_and_digests(args: dict[str, object]) -> None:
    made = Versions()
    with pytest.raises(RemoteProtocolError) as caught:
        made.hear("offers", **args)
    assert len(str(caught.value)) <= limits.CONTROL_TEXT_MAX
    assert (made.session.offers_held, made.session.copy.said) == (3, None)


@pytest.mark.parametrize(
    ("held", "right"),
    [
        (HeldOffers.of(INSTANCE, 3, 1, 2).serialize(), True),
        (HeldOffers.of(INSTANCE, 2, 1, 2).serialize(), False),
        (HeldOffers.of(bytes(16), 3, 1, 2).serialize(), False),
        (b"", False),
        (b"something of a later release", False),
    ],
)
async def test_what_a_hello_holds_counts_for_this_run_and_version(held: bytes, *, right: bool) -> None:
    made = Versions()
    made.offers.link_up(made.session, compares=True, held=held)
    assert (made.session.held_there is not None) == right
