"""Decides which side dials, when, and which of two links with one peer stays: one machine over all peers.

A peer's place is its address and port; its runs (incarnations) follow each other there. Outputs are collected and
taken with ``take``: ``Dial`` and ``CloseLink`` are orders to the driver, ``LinkUp`` and ``LinkDown`` are events for
the rooms above. Each ``Dial`` is answered by exactly one of ``link_up``, ``dial_refused`` or ``dial_failed``.

Beacons can be forged. Therefore peers that were never linked, *unverified* ones, wait in a queue for their dials,
whose rate is bounded over all of them. Peers that were linked before are dialled at once.
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
from rmpa.mesh.handshake import Hello, KnownLink, Refusal, Refuse, judge

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.core.guid import Guid
    from rmpa.core.identity import Identity

_log = logging.getLogger(__name__)

SocketAddress = tuple[str, int]

_SELDOM_MENDED: Final = frozenset(
    {Refusal.VERSION, Refusal.DOMAIN, Refusal.DUPLICATE, Refusal.MALFORMED, Refusal.LANE}
)
"""Refusals that waiting seldom mends."""
_OTHER_PEER: Final = frozenset({Refusal.MYSELF, Refusal.WRONG_PEER})
"""Refusals that concern one endpoint: another agent, or this one, answered there."""


@dataclass(frozen=True, slots=True)
class Dial:
    """Connect to this peer, at the endpoint that answers first.

    Args:
        guid: The peer.
        endpoints: Its endpoints, best first; a peer with several addresses may be reachable at some of them only.
    """

    guid: Guid
    endpoints: tuple[SocketAddress, ...]


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
    """A peer refuses links, for the first time for this reason; ``refuse`` says what to do."""

    identity: Identity
    refuse: Refuse


PeeringOutput = Dial | CloseLink | LinkUp | LinkDown | LinkRefused


@dataclass(frozen=True, slots=True)
class PeerStatus:
    """The state of one peer, for the snapshot.

    Args:
        identity: The peer.
        state: ``refused`` is a wait after a refusal that waiting seldom mends.
        link_id: Its link, if linked.
        lower: Whether this agent has the lower GUID of the two, and dials first.
        since: When the link came up, or the last one fell, monotonic seconds; ``None`` before the first.
        attempts: Dials since the last link.
        last_error: Why there is no link, as far as is known; for a linked peer, why the last one ended.
        next_attempt: When it is dialled next, monotonic seconds.
        endpoint: Where it is dialled, or was dialled last.
    """

    identity: Identity
    state: Literal["linked", "dialling", "waiting", "refused"]
    link_id: int | None
    lower: bool
    since: float | None
    attempts: int
    last_error: str
    next_attempt: float | None
    endpoint: SocketAddress | None


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
    announced: bool = False  # discovery knows it
    verified: bool = False  # it was linked before
    token_taken: bool = False  # its present dial counts against the rate of unverified peers
    gone: bool = False  # it is forgotten when its link or dial ends
    source: str | None = None
    good: SocketAddress | None = None  # where it was reached last
    link: _LinkInfo | None = None
    fell: float | None = None
    dialling: tuple[SocketAddress, ...] = ()
    tried: set[SocketAddress] = field(default_factory=set)
    next_attempt: float | None = None
    forget_at: float | None = None
    attempts: int = 0
    last_error: str = ""
    last_endpoint: SocketAddress | None = None
    refused: Refuse | None = None
    reported: set[int] = field(default_factory=set)  # refusals that were reported

    def endpoints(self) -> list[SocketAddress]:
        """Where to dial, best first: where it was reached last, its beacon's source, the addresses it announces."""
        candidates = [self.good] if self.good is not None else []
        if self.source is not None:
            candidates.append((self.source, self.identity.guid.port))
        return list(dict.fromkeys([*candidates, *self.identity.endpoints]))


class Peering:
    """The machine over all peers.

    Args:
        ours: The identity of this agent.
        rng: Uniform numbers in [0, 1), for the jitter.
        alive: Whether something came on a link, by its id, in the last ``limits.GHOST_QUIET`` seconds.
    """

    def __init__(self, ours: Identity, *, rng: Callable[[], float], alive: Callable[[int], bool]) -> None:
        self._ours = ours
        self._rng = rng
        self._alive = alive
        self._peers: dict[int, _Peer] = {}
        self._by_link: dict[int, _Peer] = {}
        self._outputs: list[PeeringOutput] = []
        self._timers: TimerQueue[int] = TimerQueue()
        self._unverified: set[int] = set()
        self._dial_queue: dict[int, None] = {}
        """Unverified peers whose dials are due, in the order in which they became so."""
        self._never_dialled: dict[int, None] = {}
        """Those of the queue that were never dialled."""
        self._newest_next = True
        self._queue_at: float | None = None
        self._dial_rate = TokenBucket(limits.DIAL_STRANGERS_RATE, limits.DIAL_STRANGERS_BURST)

    # --- events of discovery --------------------------------------------------------------------------------

    def peer_found(self, identity: Identity, now: float, source: str | None = None) -> None:
        """Discovery found a peer, or has news of it (new addresses, a restart).

        Args:
            identity: The peer.
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
            return  # outdated: the link is with a newer run
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
        """Discovery gave a peer up: do not dial it any more. A link that is up stays until it ends by itself."""
        peer = self._peers.get(guid.place)
        if peer is None or peer.identity.guid != guid:
            return
        peer.announced, peer.gone = False, True
        self._forget_if_idle(peer)

    # --- events of the driver -------------------------------------------------------------------------------

    def judge(self, hello: Hello) -> Refuse | None:
        """Decide on the hello of a dialler; ``None`` accepts it, and ``link_up`` follows."""
        peer = self._peers.get(hello.guid.place)
        known = []
        if peer is not None and peer.link is not None:
            link = peer.link
            known.append(KnownLink(link.identity.guid, link.identity.instance, link.dialled, self._alive(link.id)))
        return judge(hello, self._ours, known, busy=len(self._by_link) >= limits.LINKS_MAX)

    def link_up(
        self, link_id: int, identity: Identity, now: float, *, dialled: bool, endpoint: SocketAddress | None = None
    ) -> None:
        """A handshake succeeded.

        Args:
            link_id: The driver's number for the link, never used twice.
            identity: What the remote side says it is; discovery need not have found it.
            now: Monotonic seconds.
            dialled: Whether this side dialled.
            endpoint: Where it dialled.
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
        self._verify(peer, now)
        peer.attempts = 0
        peer.gone = False
        peer.tried.clear()
        peer.reported.clear()
        self._by_link[link_id] = peer
        self._outputs.append(LinkUp(link_id, identity))

    def link_down(self, link_id: int, reason: str, now: float, *, silent: bool = False) -> None:
        """A link ended, for whatever reason; without effect for one that was replaced or never up.

        Args:
            link_id: Its number.
            reason: Why, for people.
            now: Monotonic seconds.
            silent: Whether it fell silent: the path to the peer failed, and may be back at once.
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
        if not peer.announced and len(self._peers) > core_limits.PEERS_MAX:
            peer.gone = True  # forged identities must not fill the memory, nor cause dials
        if peer.gone:
            self._forget_if_idle(peer)
            return
        if not peer.announced:
            peer.forget_at = now + limits.FORGET_UNANNOUNCED
            self._set_timer(peer)
        if not peer.dialling:
            self._dial_at(peer, now + self._pause(peer) + (0.0 if peer.lower else limits.DIAL_FALLBACK))

    def dial_failed(self, guid: Guid, error: str, now: float, endpoint: SocketAddress | None = None) -> None:
        """A ``Dial`` was not answered, or its connection ended before the handshake did.

        Args:
            guid: The peer that was dialled.
            error: What happened.
            now: Monotonic seconds.
            endpoint: The endpoint of the connection that ended; ``None`` if no endpoint answered.
        """
        peer = self._dial_ended(guid, endpoint)
        if peer is not None:
            peer.last_error = error
            peer.refused = None
            self._retry(peer, now)

    def dial_refused(self, guid: Guid, refuse: Refuse, now: float, endpoint: SocketAddress | None = None) -> None:
        """The handshake of a ``Dial`` was refused at this endpoint, by either side."""
        peer = self._dial_ended(guid, endpoint)
        if peer is None:
            return
        peer.last_error = str(refuse)
        if refuse.code == Refusal.ALREADY_LINKED:
            # The peer has a link that was lost or is about to be accepted here: it ends within the lease.
            if peer.link is None:
                self._dial_at(peer, now + max(limits.EXPRESS_LEASE, self._pause(peer)))
            return
        if refuse.code in _OTHER_PEER or refuse.code not in _SELDOM_MENDED:
            self._retry(peer, now)
        elif peer.link is None:
            peer.refused = refuse
            pause = max(limits.REFUSED_RETRY, self._cap(peer))
            self._dial_at(peer, now + pause * (1 + 0.5 * self._rng()))
        if refuse.code not in _OTHER_PEER and refuse.code not in peer.reported:
            peer.reported.add(refuse.code)
            self._outputs.append(LinkRefused(peer.identity, refuse))

    # --- time and outputs -----------------------------------------------------------------------------------

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is due, in monotonic seconds."""
        return earliest(self._timers.next(), self._queue_at)

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
        self._dial_unverified(now)

    def take(self) -> list[PeeringOutput]:
        """Return what was decided since the last call, in order."""
        outputs, self._outputs = self._outputs, []
        return outputs

    def endpoints(self, guid: Guid) -> list[SocketAddress]:
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
        self._unverified.add(identity.guid.place)
        return peer

    def _verify(self, peer: _Peer, now: float) -> None:
        """A peer is linked: it exists, and the dial that led there does not count against the rate."""
        peer.verified = True
        self._unverified.discard(peer.identity.guid.place)
        if peer.token_taken:
            peer.token_taken = False
            self._dial_rate.put_back()
            self._dial_unverified(now)

    def _forget_if_idle(self, peer: _Peer) -> None:
        """Forget a peer that is gone; one that is being dialled only when the dial was answered."""
        peer.forget_at = None
        self._dial_at(peer, None)
        if peer.link is None and not peer.dialling:
            self._peers.pop(peer.identity.guid.place, None)
            self._unverified.discard(peer.identity.guid.place)

    def _restart(self, peer: _Peer, now: float) -> None:
        """A new run of a peer announced itself: forget errors and refusals of the run before."""
        peer.backoff.reset()
        peer.tried.clear()
        peer.reported.clear()
        peer.refused = None
        link = peer.link
        ghost = link is not None and link.identity.instance != peer.identity.instance
        if link is not None and ghost and (link.identity.guid < peer.identity.guid or not self._alive(link.id)):
            self._replace(peer, link, LinkDownCause.RESTARTED)
        if peer.link is None and not peer.dialling:
            self._dial_at(peer, now if peer.lower else now + limits.DIAL_FALLBACK)

    def _keeps(self, old: _LinkInfo, new: _LinkInfo) -> bool:
        """Whether ``old`` stays, of two links with one run of a peer.

        The one stays that the lower GUID dialled; of two that the same side dialled, the newer one.
        """
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

    def _dial_ended(self, guid: Guid, endpoint: SocketAddress | None) -> _Peer | None:
        """The peer whose dial has ended. What happened at one endpoint tells nothing about the others."""
        peer = self._peers.get(guid.place)
        if peer is None or not peer.dialling:
            return None
        if endpoint is None:
            peer.tried.update(peer.dialling)
        else:
            peer.tried.add(endpoint)
            peer.last_endpoint = endpoint
        peer.dialling = ()
        peer.token_taken = False
        if peer.gone:
            self._forget_if_idle(peer)
            return None
        return peer

    def _retry(self, peer: _Peer, now: float) -> None:
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
        """The longest pause between dials, in seconds: unverified peers share the rate of all of them."""
        if peer.verified:
            return limits.BACKOFF_MAX
        return max(limits.BACKOFF_MAX, len(self._unverified) / limits.DIAL_STRANGERS_RATE)

    def _pause(self, peer: _Peer) -> float:
        peer.backoff.cap = self._cap(peer)
        return peer.backoff.delay()

    def _set_timer(self, peer: _Peer) -> None:
        place = peer.identity.guid.place
        attempt = None if place in self._dial_queue else peer.next_attempt
        self._timers.set(place, earliest(attempt, peer.forget_at))

    def _dial_at(self, peer: _Peer, when: float | None) -> None:
        """Set when the next dial is due; ``None``: never."""
        place = peer.identity.guid.place
        peer.next_attempt = when
        self._dial_queue.pop(place, None)
        self._never_dialled.pop(place, None)
        self._set_timer(peer)

    def _dial_due(self, peer: _Peer, now: float) -> None:
        """Dial a peer if it is time; an unverified one joins the queue."""
        due = peer.next_attempt
        if due is None or now < due or peer.link is not None or peer.dialling:
            return
        if peer.verified:
            self._dial(peer)
            return
        place = peer.identity.guid.place
        self._dial_queue[place] = None
        if not peer.attempts:
            self._never_dialled[place] = None
        self._set_timer(peer)
        self._dial_unverified(now)

    def _dial_unverified(self, now: float) -> None:
        """Dial unverified peers of the queue as far as the rate allows.

        In turn the newest that was never dialled, because a real peer must not wait behind many forged ones, and the
        one that waits longest, because it must not wait for ever.
        """
        while self._dial_queue and self._dial_rate.take(now):
            newest = self._newest_next and self._never_dialled
            place = next(reversed(self._never_dialled) if newest else iter(self._dial_queue))
            self._newest_next = not self._newest_next
            peer = self._peers[place]
            peer.token_taken = True
            self._dial(peer)
        self._queue_at = self._dial_rate.next(now) if self._dial_queue else None

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
