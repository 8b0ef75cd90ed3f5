"""Who dials whom, when, and which of two links stays: one machine over all peers.

A peer's place is its address and port; its incarnations follow each other there. Outputs are collected and
taken with ``take``: ``Dial`` and ``CloseLink`` are orders to the driver, ``LinkUp`` and ``LinkDown`` tell the
rooms above. Each ``Dial`` is answered by exactly one of ``link_up``, ``dial_refused`` or ``dial_failed``.

Anybody can invent peers. So those that were never linked, strangers, stand in line for their dials, which are bounded
over all of them; who was linked before does not notice.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Final, Literal

from rmpa.core import limits as core_limits
from rmpa.core.backoff import Backoff
from rmpa.core.clock import earliest
from rmpa.core.timer_queue import TimerQueue
from rmpa.core.token_bucket import TokenBucket
from rmpa.mesh import limits
from rmpa.mesh.handshake import Hello, KnownLink, Refusal, Refuse, Verdict, judge

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.core.guid import Guid
    from rmpa.core.identity import Identity

_log = logging.getLogger(__name__)

Endpoint = tuple[str, int]

_SLOW: Final = frozenset({Refusal.VERSION, Refusal.DOMAIN, Refusal.DUPLICATE, Refusal.MALFORMED, Refusal.LANE})
_ELSEWHERE: Final = frozenset({Refusal.MYSELF, Refusal.WRONG_PEER})


@dataclass(frozen=True, slots=True)
class Dial:
    """Connect to this peer, at whichever of its endpoints answers first.

    Args:
        guid: Who should be there.
        endpoints: Where to try, best first; a peer with several addresses may be reached at some of them only.
    """

    guid: Guid
    endpoints: tuple[Endpoint, ...]


@dataclass(frozen=True, slots=True)
class CloseLink:
    """Say bye on this link and close it."""

    link_id: int
    reason: str


@dataclass(frozen=True, slots=True)
class LinkUp:
    """This link is the one that is used with its peer."""

    link_id: int
    identity: Identity


class LinkDownCause(Enum):
    """Why a link is not used any more; the value is the text for people."""

    REPLACED = "replaced by a newer link"
    """The same run of the peer has another link in the same moment."""
    RESTARTED = "the peer restarted"
    """Another run of the peer has taken its place."""
    ENDED = "the connection ended"
    """The connection of its express lane ended; ``LinkDown.reason`` says how."""


@dataclass(frozen=True, slots=True)
class LinkDown:
    """The link that was used with this peer is not used any more.

    Args:
        link_id: Its number.
        identity: The peer.
        cause: What kind of end it was.
        reason: Why, for people.
    """

    link_id: int
    identity: Identity
    cause: LinkDownCause
    reason: str


@dataclass(frozen=True, slots=True)
class LinkRefused:
    """A peer said no, for the first time for this reason; what to do is in the text."""

    identity: Identity
    refuse: Refuse


Output = Dial | CloseLink | LinkUp | LinkDown | LinkRefused


@dataclass(frozen=True, slots=True)
class PeerStatus:
    """One peer, for the monitor.

    Args:
        identity: Who.
        state: ``refused`` is a wait after a no that waiting seldom mends.
        link_id: Its link, if linked.
        lower: Whether we are the lower GUID, which dials first.
        since: When the link came up, or the last one fell; ``None`` before the first. In monotonic seconds.
        attempts: Dials since the last link.
        last_error: Why there is no link, as far as we know; for a linked peer, why the last one ended.
        next_attempt: When we dial next, in monotonic seconds.
        endpoint: Where we dial or dialled last.
    """

    identity: Identity
    state: Literal["linked", "dialling", "waiting", "refused"]
    link_id: int | None
    lower: bool
    since: float | None
    attempts: int
    last_error: str
    next_attempt: float | None
    endpoint: Endpoint | None


@dataclass(slots=True)
class _LinkInfo:
    id: int
    identity: Identity
    dialled: bool
    since: float


@dataclass(slots=True)
class _Peer:
    identity: Identity
    lower: bool
    backoff: Backoff
    announced: bool = False
    stranger: bool = True
    paid: bool = False
    gone: bool = False
    source: str | None = None
    good: Endpoint | None = None
    link: _LinkInfo | None = None
    fell: float | None = None
    dialling: tuple[Endpoint, ...] = ()
    tried: set[Endpoint] = field(default_factory=set)
    next_attempt: float | None = None
    forget_at: float | None = None
    attempts: int = 0
    last_error: str = ""
    last_endpoint: Endpoint | None = None
    refused: Refuse | None = None
    said: set[int] = field(default_factory=set)

    def endpoints(self) -> list[Endpoint]:
        """Where to dial, best first: what worked last, where its beacon came from, what it says of itself."""
        candidates = [self.good] if self.good is not None else []
        if self.source is not None:
            candidates.append((self.source, self.identity.guid.port))
        return list(dict.fromkeys([*candidates, *self.identity.endpoints]))


class Peering:
    """The machine over all peers.

    Args:
        ours: Who we are.
        rng: Uniform numbers in [0, 1), for the jitter.
        alive: Whether a link, by its id, heard something in the last ``limits.GHOST_QUIET`` seconds.
    """

    def __init__(self, ours: Identity, *, rng: Callable[[], float], alive: Callable[[int], bool]) -> None:
        self._ours = ours
        self._rng = rng
        self._alive = alive
        self._peers: dict[int, _Peer] = {}
        self._by_link: dict[int, _Peer] = {}
        self._outputs: list[Output] = []
        self._timers: TimerQueue[int] = TimerQueue()
        self._strangers: set[int] = set()
        # Strangers whose dials are due, who came first in front, and of these the ones that were never dialled.
        self._line: dict[int, None] = {}
        self._untried: dict[int, None] = {}
        self._untried_next = True
        self._line_at: float | None = None
        self._allowed = TokenBucket(limits.DIAL_STRANGERS_RATE, limits.DIAL_STRANGERS_BURST)

    # --- what discovery says --------------------------------------------------------------------------------

    def peer_found(self, identity: Identity, now: float, source: str | None = None) -> None:
        """Discovery knows a peer, or knows it better (new addresses, a restart).

        Args:
            identity: Who.
            now: Monotonic seconds.
            source: The address that its beacon came from, if it was the peer's own beacon.
        """
        if identity.instance == self._ours.instance or identity.guid.place == self._ours.guid.place:
            return
        peer = self._peers.get(identity.guid.place)
        if peer is None:
            peer = self._add(identity)
        restarted = peer.identity.instance != identity.instance
        fresh = not peer.announced or restarted
        if restarted and identity.guid < peer.identity.guid and peer.link is not None:
            return  # old news: the link is with a newer instance
        peer.announced, peer.gone, peer.forget_at = True, False, None
        self._set_timer(peer)
        peer.source = source or peer.source
        peer.identity = identity
        if restarted:
            peer.lower = self._ours.guid < identity.guid
            self._restart(peer, now)
        if fresh and peer.link is None and not peer.dialling:
            self._dial_at(peer, now if peer.lower else now + limits.DIAL_FALLBACK)
        self._dial_due(peer, now)

    def peer_gone(self, guid: Guid, now: float) -> None:  # noqa: ARG002 - all machines are told the time
        """Discovery gave a peer up: dial it no more. A link that is up stays until it falls by itself."""
        peer = self._peers.get(guid.place)
        if peer is None or peer.identity.guid != guid:
            return
        peer.announced, peer.gone = False, True
        self._forget_if_idle(peer)

    # --- what the driver says -------------------------------------------------------------------------------

    def judge(self, hello: Hello) -> Verdict:
        """Decide on a hello that came in; ``None`` is a welcome, and ``link_up`` follows."""
        peer = self._peers.get(hello.guid.place)
        known = []
        if peer is not None and peer.link is not None:
            link = peer.link
            known.append(KnownLink(link.identity.guid, link.identity.instance, link.dialled, self._alive(link.id)))
        return judge(hello, self._ours, known, busy=len(self._by_link) >= limits.LINKS_MAX)

    def link_up(
        self, link_id: int, identity: Identity, now: float, *, dialled: bool, endpoint: Endpoint | None = None
    ) -> None:
        """A handshake ended well.

        Args:
            link_id: The driver's number for the link, never used twice.
            identity: Who the other side says it is; discovery need not have seen it.
            now: Monotonic seconds.
            dialled: Whether we dialled.
            endpoint: Where we dialled.
        """
        peer = self._peers.get(identity.guid.place) or self._add(identity)
        if dialled:
            peer.dialling = ()
            peer.good = peer.last_endpoint = endpoint
        new = _LinkInfo(link_id, identity, dialled, now)
        old = peer.link
        if old is not None and self._keeps(old, new):
            self._outputs.append(CloseLink(link_id, "we are linked already; the lower GUID's link stays"))
            return
        if old is not None:
            same_run = old.identity.instance == identity.instance
            self._replace(peer, old, LinkDownCause.REPLACED if same_run else LinkDownCause.RESTARTED)
        if peer.identity.instance != identity.instance:
            peer.identity = identity
            peer.lower = self._ours.guid < identity.guid
            peer.backoff.reset()
        peer.link = new
        peer.forget_at = peer.refused = None
        self._dial_at(peer, None)
        self._met(peer, now)
        peer.attempts = 0
        peer.gone = False
        peer.tried.clear()
        peer.said.clear()
        self._by_link[link_id] = peer
        self._outputs.append(LinkUp(link_id, identity))

    def link_down(self, link_id: int, reason: str, now: float, *, silent: bool = False) -> None:
        """A link ended, for whatever reason; one that was replaced or never up says nothing new.

        Args:
            link_id: Which.
            reason: Why.
            now: Monotonic seconds.
            silent: It fell silent: the way to the peer is what failed, and may be back at once.
        """
        peer = self._by_link.get(link_id)
        if peer is None or peer.link is None:
            return
        link = peer.link
        self._drop(peer, link, LinkDownCause.ENDED, reason)
        peer.fell = now
        peer.last_error = reason
        if silent or now - link.since >= limits.LINK_STABLE:
            peer.backoff.reset()
        if not peer.announced and len(self._peers) > core_limits.ROSTER_PEERS_MAX:
            peer.gone = True  # invented identities must not fill the memory, nor make us dial for them
        if peer.gone:
            self._forget_if_idle(peer)
            return
        if not peer.announced:
            peer.forget_at = now + limits.FORGET_UNANNOUNCED
            self._set_timer(peer)
        if not peer.dialling:
            self._dial_at(peer, now + self._pause(peer) + (0.0 if peer.lower else limits.DIAL_FALLBACK))

    def dial_failed(self, guid: Guid, error: str, now: float, endpoint: Endpoint | None = None) -> None:
        """Nobody answered a ``Dial``, or the connection ended before the handshake did.

        Args:
            guid: Whose.
            error: What happened.
            now: Monotonic seconds.
            endpoint: Where the connection was that ended; ``None`` if no endpoint answered.
        """
        peer = self._answered(guid, endpoint)
        if peer is not None:
            peer.last_error = error
            peer.refused = None
            self._again(peer, now)

    def dial_refused(self, guid: Guid, refuse: Refuse, now: float, endpoint: Endpoint | None = None) -> None:
        """A ``Dial`` was answered with a no, by them or by us, at this endpoint."""
        peer = self._answered(guid, endpoint)
        if peer is None:
            return
        peer.last_error = str(refuse)
        if refuse.code == Refusal.ALREADY_LINKED:
            # They hold a link that we lost, or that is about to be welcomed here: it falls within the lease.
            if peer.link is None:
                self._dial_at(peer, now + max(limits.LINK_LEASE, self._pause(peer)))
            return
        if refuse.code in _ELSEWHERE or refuse.code not in _SLOW:
            self._again(peer, now)
        elif peer.link is None:
            peer.refused = refuse
            pause = max(limits.REFUSED_RETRY, self._cap(peer))
            self._dial_at(peer, now + pause * (1 + 0.5 * self._rng()))
        if refuse.code not in _ELSEWHERE and refuse.code not in peer.said:
            peer.said.add(refuse.code)
            self._outputs.append(LinkRefused(peer.identity, refuse))

    # --- time and outputs -----------------------------------------------------------------------------------

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is due, in monotonic seconds."""
        return earliest(self._timers.next(), self._line_at)

    def handle_timer(self, now: float) -> None:
        """Dial and forget what is due."""
        for place in self._timers.take(now):
            peer = self._peers[place]
            if peer.forget_at is not None and now >= peer.forget_at:
                peer.gone = True
                self._forget_if_idle(peer)
            else:
                self._set_timer(peer)
                self._dial_due(peer, now)
        self._admit(now)

    def take(self) -> list[Output]:
        """What was decided since the last call, in order."""
        outputs, self._outputs = self._outputs, []
        return outputs

    def endpoints(self, guid: Guid) -> list[Endpoint]:
        """Where a peer may be reached, best first; empty for one that is not known."""
        peer = self._peers.get(guid.place)
        return peer.endpoints() if peer is not None else []

    def peers(self) -> list[PeerStatus]:
        """All known peers, by GUID."""
        return [_status(p) for p in sorted(self._peers.values(), key=lambda p: p.identity.guid)]

    # --- inside ---------------------------------------------------------------------------------------------

    def _add(self, identity: Identity) -> _Peer:
        backoff = Backoff(limits.BACKOFF_FIRST, limits.BACKOFF_MAX, self._rng)
        peer = _Peer(identity, self._ours.guid < identity.guid, backoff)
        self._peers[identity.guid.place] = peer
        self._strangers.add(identity.guid.place)
        return peer

    def _met(self, peer: _Peer, now: float) -> None:
        """A peer is linked: it exists, and a dial that led there was none too many."""
        peer.stranger = False
        self._strangers.discard(peer.identity.guid.place)
        if peer.paid:
            peer.paid = False
            self._allowed.put_back()
            self._admit(now)

    def _forget_if_idle(self, peer: _Peer) -> None:
        """Forget a peer that is gone; one that we are dialling only when the dial was answered."""
        peer.forget_at = None
        self._dial_at(peer, None)
        if peer.link is None and not peer.dialling:
            self._peers.pop(peer.identity.guid.place, None)
            self._strangers.discard(peer.identity.guid.place)

    def _restart(self, peer: _Peer, now: float) -> None:
        """A new instance announced itself: nothing that its ghost did counts."""
        peer.backoff.reset()
        peer.tried.clear()
        peer.said.clear()
        peer.refused = None
        link = peer.link
        ghost = link is not None and link.identity.instance != peer.identity.instance
        if link is not None and ghost and (link.identity.guid < peer.identity.guid or not self._alive(link.id)):
            self._replace(peer, link, LinkDownCause.RESTARTED)
        if peer.link is None and not peer.dialling:
            self._dial_at(peer, now if peer.lower else now + limits.DIAL_FALLBACK)

    def _keeps(self, old: _LinkInfo, new: _LinkInfo) -> bool:
        """Of two links with one instance: the one that the lower GUID dialled; of one direction, the newer."""
        if old.identity.instance != new.identity.instance or old.dialled == new.dialled:
            return False
        return old.dialled == (self._ours.guid < old.identity.guid)

    def _replace(self, peer: _Peer, link: _LinkInfo, cause: LinkDownCause) -> None:
        """Close a link that another one, or another run of the peer, takes the place of."""
        self._outputs.append(CloseLink(link.id, cause.value))
        self._drop(peer, link, cause, cause.value)

    def _drop(self, peer: _Peer, link: _LinkInfo, cause: LinkDownCause, reason: str) -> None:
        peer.link = None
        self._by_link.pop(link.id, None)
        self._outputs.append(LinkDown(link.id, link.identity, cause, reason))

    def _answered(self, guid: Guid, endpoint: Endpoint | None) -> _Peer | None:
        """The peer that was dialled. Who answered at one endpoint says nothing of the others."""
        peer = self._peers.get(guid.place)
        if peer is None or not peer.dialling:
            return None
        if endpoint is None:
            peer.tried.update(peer.dialling)
        else:
            peer.tried.add(endpoint)
            peer.last_endpoint = endpoint
        peer.dialling = ()
        peer.paid = False
        if peer.gone:
            self._forget_if_idle(peer)
            return None
        return peer

    def _again(self, peer: _Peer, now: float) -> None:
        """Try the other endpoints at once, or wait when all were tried."""
        if peer.link is not None:
            return
        if peer.tried.issuperset(peer.endpoints()):
            peer.tried.clear()
            peer.good = None
            self._dial_at(peer, now + self._pause(peer))
        else:
            self._dial_at(peer, now)

    # --- when to dial ---------------------------------------------------------------------------------------

    def _cap(self, peer: _Peer) -> float:
        """The longest pause between dials: strangers share what all of them may have."""
        if not peer.stranger:
            return limits.BACKOFF_MAX
        return max(limits.BACKOFF_MAX, len(self._strangers) / limits.DIAL_STRANGERS_RATE)

    def _pause(self, peer: _Peer) -> float:
        peer.backoff.cap = self._cap(peer)
        return peer.backoff.delay()

    def _set_timer(self, peer: _Peer) -> None:
        place = peer.identity.guid.place
        attempt = None if place in self._line else peer.next_attempt
        self._timers.set(place, earliest(attempt, peer.forget_at))

    def _dial_at(self, peer: _Peer, when: float | None) -> None:
        """Let the next dial be due then, or not at all."""
        place = peer.identity.guid.place
        peer.next_attempt = when
        self._line.pop(place, None)
        self._untried.pop(place, None)
        self._set_timer(peer)

    def _dial_due(self, peer: _Peer, now: float) -> None:
        """Dial if it is time; a stranger when its turn comes."""
        due = peer.next_attempt
        if due is None or now < due or peer.link is not None or peer.dialling:
            return
        if not peer.stranger:
            self._dial(peer)
            return
        place = peer.identity.guid.place
        self._line[place] = None
        if not peer.attempts:
            self._untried[place] = None
        self._set_timer(peer)
        self._admit(now)

    def _admit(self, now: float) -> None:
        """Dial strangers as far as all of them may be.

        In turn the newest that was never dialled, for a real one must not wait behind many invented ones, and who
        waits longest, for it must not wait for ever.
        """
        while self._line and self._allowed.take(now):
            newest = self._untried_next and self._untried
            place = next(reversed(self._untried) if newest else iter(self._line))
            self._untried_next = not self._untried_next
            peer = self._peers[place]
            peer.paid = True
            self._dial(peer)
        self._line_at = self._allowed.next(now) if self._line else None

    def _dial(self, peer: _Peer) -> None:
        self._dial_at(peer, None)
        left = [e for e in peer.endpoints() if e not in peer.tried]
        if not left:
            peer.tried.clear()
            left = peer.endpoints()
        peer.dialling = tuple(left)
        peer.last_endpoint = left[0]
        peer.attempts += 1
        self._outputs.append(Dial(peer.identity.guid, peer.dialling))


def _status(peer: _Peer) -> PeerStatus:
    state: Literal["linked", "dialling", "waiting", "refused"]
    if peer.link is not None:
        state = "linked"
    elif peer.dialling:
        state = "dialling"
    else:
        state = "waiting" if peer.refused is None else "refused"
    link = peer.link
    return PeerStatus(
        peer.identity if link is None else link.identity,
        state,
        None if link is None else link.id,
        peer.lower,
        peer.fell if link is None else link.since,
        peer.attempts,
        peer.last_error,
        peer.next_attempt,
        peer.last_endpoint,
    )
