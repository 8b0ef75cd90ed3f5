"""Decides which side dials, when, and which of two links with one peer stays: one machine over all peers.

A peer's place is its address and port; its runs (incarnations) follow each other there. Outputs are collected, and
returned by ``take``: ``Dial`` and ``CloseLink`` are orders to the driver, ``LinkUp`` and ``LinkDown`` are events for
the rooms above. Each ``Dial`` is answered by exactly one of ``link_up``, ``dial_refused`` or ``dial_failed``.

Beacons can be forged. Therefore *unverified* peers, which were never linked, are dialled from a queue, at a rate that
is bounded over all of them. Peers that were linked before are dialled at once.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from rmpa.core import limits as core_limits
from rmpa.core.counters import Backoff, TimerQueue, TokenBucket, earliest
from rmpa.mesh import limits
from rmpa.mesh.frames import FULL, Hello, KnownLink, Lane, Refusal, Refuse, judge
from rmpa.mesh.keepalive import (
    OTHER_PEER,
    SELDOM_MENDED,
    UNPROVEN,
    CloseLink,
    Dial,
    LinkDown,
    LinkDownCause,
    LinkRefused,
    LinkUp,
    PeeringOutput,
    PeerStatus,
    SocketAddress,
)
from rmpa.trust.permissions import NOT_OF_THIS_MESH, TrustReason

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.core.identity import Guid, Identity

_log = logging.getLogger(__name__)


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
    announced: bool = False  # discovery knows the peer
    verified: bool = False  # the peer was linked before
    token_taken: bool = False  # the present dial counts against the rate of unverified peers
    gone: bool = False  # the peer is forgotten when its link or dial ends
    source: str | None = None
    good: SocketAddress | None = None  # the endpoint where the peer was reached last
    link: _LinkInfo | None = None
    fell: float | None = None
    dialling: tuple[SocketAddress, ...] = ()
    hello_at: float | None = None  # when the present dial sent its hello
    tried: set[SocketAddress] = field(default_factory=set)
    next_attempt: float | None = None
    forget_at: float | None = None
    pursued_until: float = -math.inf  # dialled by short attempts until then
    attempts: int = 0
    last_error: str = ""
    last_endpoint: SocketAddress | None = None
    refused: Refuse | None = None
    reported: set[int] = field(default_factory=set)  # refusals that were reported

    @property
    def has_place(self) -> bool:
        """Whether it is one of the modules of this mesh."""
        return self.link is not None or (self.verified and self.announced)

    def endpoints(self) -> list[SocketAddress]:
        """The endpoints to dial, best first: the last one that worked, the beacon's source, the announced ones."""
        candidates = [self.good] if self.good is not None else []
        if self.source is not None:
            candidates.append((self.source, self.identity.guid.port))
        return list(dict.fromkeys([*candidates, *self.identity.endpoints]))


class Peering:
    """The machine over all peers.

    Args:
        ours: The identity of this agent.
        rng: Uniform numbers in [0, 1), for the jitter.
        alive: Returns whether bytes arrived on a link, given by its id, in the last ``limits.GHOST_QUIET`` seconds.
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
        """Unverified peers whose dials are due, the one that has been due longest first."""
        self._never_dialled: dict[int, None] = {}
        """The peers of the queue that were never dialled."""
        self._newest_next = True
        self._reported_full: set[int] = set()
        """``Refusal.FULL`` once one of all peers has said so, until a link comes up."""
        self._pursued: set[int] = set()
        """Peers whose links were in use and fell silent within ``limits.PURSUIT``."""
        self._queue_at: float | None = None
        self._dial_rate = TokenBucket(limits.DIAL_STRANGERS_RATE, limits.DIAL_STRANGERS_BURST)

    # --- events of discovery --------------------------------------------------------------------------------

    def peer_found(self, identity: Identity, now: float, source: str | None = None) -> None:
        """Take in a peer that discovery found, or news of it (new addresses, a restart).

        Args:
            identity: The peer.
            now: Monotonic seconds.
            source: The source address of the peer's own beacon; ``None`` if it was found in another way.
        """
        if identity.instance == self._ours.instance or identity.guid.place == self._ours.guid.place:
            return
        peer = self._peers.get(identity.guid.place)
        if peer is None:
            peer = self._add(identity)
        restarted = peer.identity.instance != identity.instance
        fresh = not peer.announced or restarted
        if restarted and identity.guid < peer.identity.guid and peer.link is not None:
            return  # an outdated report: the link is with a newer run
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

    def peer_gone(self, guid: Guid, now: float) -> None:  # noqa: ARG002 - all machines get the time
        """Stop dialling a peer that discovery has given up. A link that is up stays until it ends by itself."""
        peer = self._peers.get(guid.place)
        if peer is None or peer.identity.guid != guid:
            return
        peer.announced, peer.gone = False, True
        self._forget_if_idle(peer)

    # --- events of the driver -------------------------------------------------------------------------------

    def judge(self, hello: Hello, now: float) -> Refuse | None:
        """Decide on a received hello; ``None`` accepts it, and the driver then calls ``link_up``."""
        peer = self._peers.get(hello.guid.place)
        if peer is not None and hello.lane == Lane.EXPRESS and self._crosses(peer, hello, now):
            text = "we dial each other; the link that the lower GUID dials stays"
            return Refuse(Refusal.ALREADY_LINKED, text)
        known = []
        if peer is not None and peer.link is not None:
            link = peer.link
            known.append(KnownLink(link.identity.guid, link.identity.instance, link.dialled, self._alive(link.id)))
        refuse = judge(hello, self._ours, known, full=self._full(peer))
        if refuse is FULL:
            self.link_refused(hello.guid, refuse)
        return refuse

    def _full(self, peer: _Peer | None = None) -> bool:
        """Whether the mesh has no place for this peer, or for a new one.

        A place is taken by a link, and kept while its peer is away for a moment: until discovery has given it up.
        """
        if len(self._peers) < limits.MODULES_MAX or (peer is not None and peer.has_place):
            return False
        return sum(each.has_place for each in self._peers.values()) >= limits.MODULES_MAX - 1

    def dial_opened(self, guid: Guid, now: float) -> bool:
        """Take in that a ``Dial`` has a connection, on which the hello is sent next.

        Returns:
            Whether the connection is still wanted. If not, because the peer's own dial led to a link meanwhile, the
            driver closes it, and this dial is over.
        """
        peer = self._peers.get(guid.place)
        if peer is None or not peer.dialling:
            return True
        if peer.link is None:
            peer.hello_at = now
            return True
        peer.dialling, peer.token_taken = (), False
        return False

    def link_up(
        self, link_id: int, identity: Identity, now: float, *, dialled: bool, endpoint: SocketAddress | None = None
    ) -> None:
        """Take in a link whose handshake succeeded.

        Args:
            link_id: The driver's number for the link, never used twice.
            identity: The remote side's identity from the handshake; discovery need not have found it.
            now: Monotonic seconds.
            dialled: Whether this side dialled.
            endpoint: The endpoint that this side dialled.
        """
        peer = self._peers.get(identity.guid.place) or self._add(identity)
        if dialled:
            peer.dialling, peer.hello_at = (), None
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
        self._end_pursuit(peer)
        peer.forget_at = peer.refused = None
        self._dial_at(peer, None)
        self._verify(peer, now)
        peer.attempts = 0
        peer.gone = False
        peer.tried.clear()
        peer.reported.clear()
        self._reported_full.clear()
        self._by_link[link_id] = peer
        self._outputs.append(LinkUp(link_id, identity))

    def link_down(
        self,
        link_id: int,
        reason: str,
        now: float,
        *,
        silent: bool = False,
        needed: bool = False,
    ) -> None:
        """Handle the end of a link; without effect for a link that was replaced or never up.

        Args:
            link_id: Its number.
            reason: Why, for people.
            now: Monotonic seconds.
            silent: Whether the link ended by silence: the path to the peer failed, and may work again at once.
            needed: Whether something at either side depended on it, so that the peer is worth many attempts.
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
        if silent and needed:
            peer.pursued_until = now + limits.PURSUIT
            self._pursued.add(peer.identity.guid.place)
        if not peer.dialling:
            self._dial_at(peer, now + self._pause(peer, now) + (0.0 if peer.lower else limits.DIAL_FALLBACK))

    def dial_failed(self, guid: Guid, error: str, now: float, endpoint: SocketAddress | None = None) -> None:
        """Handle a ``Dial`` without an answer, or whose connection ended before its handshake was done.

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

    def dial_refused(
        self, guid: Guid, refuse: Refuse, now: float, endpoint: SocketAddress | None = None, *, proved: bool = True
    ) -> None:
        """Handle a ``Dial`` that was refused at this endpoint, by either side; without a proof it is only shown."""
        peer = self._dial_ended(guid, endpoint)
        if peer is None:
            return
        peer.last_error = str(refuse)
        if refuse.code == Refusal.ALREADY_LINKED:
            # The peer has a link that was lost here (it ends within the lease), or that is about to be accepted here.
            if peer.link is None:
                self._dial_at(peer, now + max(limits.EXPRESS_LEASE, self._pause(peer, now)))
            return
        if refuse.code in UNPROVEN or not proved:
            peer.refused = refuse
        if not proved or refuse.code in OTHER_PEER or refuse.code not in SELDOM_MENDED:
            self._retry(peer, now)
        elif peer.link is None:
            peer.refused = refuse
            pause = max(limits.REFUSED_RETRY, self._cap(peer))
            self._dial_at(peer, now + pause * (1 + 0.5 * self._rng()))
        reported = self._reported_full if refuse.code == Refusal.FULL else peer.reported
        if refuse.code not in OTHER_PEER and refuse.code not in reported:
            reported.add(refuse.code)
            self._outputs.append(LinkRefused(peer.identity, refuse))

    def link_refused(self, guid: Guid, refuse: Refuse) -> None:
        """Note why there is no link with a peer, which was found on a connection that the peer dialled."""
        peer = self._peers.get(guid.place)
        if peer is not None and peer.link is None:
            peer.refused, peer.last_error = refuse, str(refuse)

    def refused_from(self, host: str, refuse: Refuse) -> None:
        """Note a refusal before the peer said its name, if only one unlinked peer can have dialled from there."""
        there = [p for p in self._peers.values() if p.link is None and any(e[0] == host for e in p.endpoints())]
        if len(there) == 1:
            self.link_refused(there[0].identity.guid, refuse)

    @property
    def left_out(self) -> bool:
        """Whether a mesh that is full has refused this module, and no link has come up since."""
        return bool(self._reported_full)

    # --- time and outputs -----------------------------------------------------------------------------------

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is due, in monotonic seconds."""
        return earliest(self._timers.next(), self._queue_at)

    def handle_timer(self, now: float) -> None:
        """Dial and forget the peers whose time has come."""
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
        """Return the outputs since the last call, in order."""
        outputs, self._outputs = self._outputs, []
        return outputs

    def endpoints(self, guid: Guid) -> list[SocketAddress]:
        """The endpoints at which a peer may be reached, best first; empty for an unknown peer."""
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
        """Mark a linked peer as verified; a dial that led to the link does not count against the rate."""
        peer.verified = True
        self._unverified.discard(peer.identity.guid.place)
        if peer.token_taken:
            peer.token_taken = False
            self._dial_rate.put_back()
            self._dial_unverified(now)

    def _forget_if_idle(self, peer: _Peer) -> None:
        """Forget a peer that is gone, unless it has a link or an unanswered dial."""
        peer.forget_at = None
        self._dial_at(peer, None)
        if peer.link is None and not peer.dialling:
            self._end_pursuit(peer)
            self._peers.pop(peer.identity.guid.place, None)
            self._unverified.discard(peer.identity.guid.place)

    def _restart(self, peer: _Peer, now: float) -> None:
        """Forget the errors and refusals of a peer's former run, because a new run announced itself."""
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

    def _crosses(self, peer: _Peer, hello: Hello, now: float) -> bool:
        """Whether a hello crosses that of this side, whose link stays.

        The link of the hello would be replaced a round trip later, with the calls that are made over it meanwhile. An
        unverified peer is accepted all the same: a forged beacon may lead this side's dial to an address without an
        answer.
        """
        if not peer.lower or not peer.verified or peer.link is not None or peer.hello_at is None:
            return False
        same_run = peer.identity.instance == hello.instance
        return same_run and now - peer.hello_at < limits.CROSSING_TIME

    def _keeps(self, old: _LinkInfo, new: _LinkInfo) -> bool:
        """Whether the old one of two links with one run of a peer stays.

        The link that the agent with the lower GUID dialled stays; if the same side dialled both, the newer one stays.
        """
        if old.identity.instance != new.identity.instance or old.dialled == new.dialled:
            return False
        return old.dialled == (self._ours.guid < old.identity.guid)

    def _replace(self, peer: _Peer, link: _LinkInfo, cause: LinkDownCause) -> None:
        """Close a link that is replaced by another link, or whose run of the peer is replaced."""
        self._outputs.append(CloseLink(link.id, cause.value))
        self._drop(peer, link, cause, cause.value)

    def _drop(self, peer: _Peer, link: _LinkInfo, cause: LinkDownCause, reason: str) -> None:
        peer.link = None
        self._by_link.pop(link.id, None)
        self._outputs.append(LinkDown(link.id, link.identity, cause, reason))

    def _dial_ended(self, guid: Guid, endpoint: SocketAddress | None) -> _Peer | None:
        """End a peer's dial, and mark the endpoint (``None``: all dialled ones) as tried.

        Returns:
            The peer; ``None`` if it was not being dialled, or is gone.
        """
        peer = self._peers.get(guid.place)
        if peer is None or not peer.dialling:
            return None
        if endpoint is None:
            peer.tried.update(peer.dialling)
        else:
            peer.tried.add(endpoint)
            peer.last_endpoint = endpoint
        peer.dialling, peer.hello_at = (), None
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
            self._dial_at(peer, now + self._pause(peer, now))
        else:
            self._dial_at(peer, now)

    # --- when to dial ---------------------------------------------------------------------------------------

    def _cap(self, peer: _Peer) -> float:
        """The longest pause between dials, in seconds: unverified peers share the rate of all of them."""
        if peer.verified:
            return limits.BACKOFF_MAX
        return max(limits.BACKOFF_MAX, len(self._unverified) / limits.DIAL_STRANGERS_RATE)

    def _pause(self, peer: _Peer, now: float) -> float:
        if self._is_pursued(peer, now):
            shared = len(self._pursued) / limits.PURSUITS_PER_SECOND
            return max(limits.REDIAL_PAUSE, shared) * (0.5 + self._rng())
        peer.backoff.cap = self._cap(peer)
        return peer.backoff.delay()

    def _end_pursuit(self, peer: _Peer) -> None:
        peer.pursued_until = -math.inf
        self._pursued.discard(peer.identity.guid.place)

    def _is_pursued(self, peer: _Peer, now: float) -> bool:
        """Whether a peer is dialled by short attempts, many of them."""
        if now < peer.pursued_until:
            return True
        self._pursued.discard(peer.identity.guid.place)
        return False

    def _set_timer(self, peer: _Peer) -> None:
        place = peer.identity.guid.place
        attempt = None if place in self._dial_queue else peer.next_attempt
        self._timers.set(place, earliest(attempt, peer.forget_at))

    def _dial_at(self, peer: _Peer, when: float | None) -> None:
        """Set the time of the next dial; ``None``: never."""
        place = peer.identity.guid.place
        peer.next_attempt = when
        self._dial_queue.pop(place, None)
        self._never_dialled.pop(place, None)
        self._set_timer(peer)

    def _dial_due(self, peer: _Peer, now: float) -> None:
        """Dial a peer whose dial is due; an unverified one joins the queue instead."""
        due = peer.next_attempt
        if due is None or now < due or peer.link is not None or peer.dialling:
            return
        if peer.verified:
            self._dial(peer, briefly=self._is_pursued(peer, now))
            return
        place = peer.identity.guid.place
        self._dial_queue[place] = None
        if not peer.attempts:
            self._never_dialled[place] = None
        self._set_timer(peer)
        self._dial_unverified(now)

    def _dial_unverified(self, now: float) -> None:
        """Dial unverified peers of the queue as far as the rate allows.

        It takes in turn the newest peer that was never dialled, so that a real peer does not wait for many forged
        ones, and the peer that has waited longest, so that no peer waits forever.
        """
        if self._dial_queue and self._full():
            self._queue_at = now + limits.REFUSED_RETRY
            return
        while self._dial_queue and self._dial_rate.take(now):
            newest = self._newest_next and self._never_dialled
            place = next(reversed(self._never_dialled) if newest else iter(self._dial_queue))
            self._newest_next = not self._newest_next
            peer = self._peers[place]
            peer.token_taken = True
            self._dial(peer)
        self._queue_at = self._dial_rate.next(now) if self._dial_queue else None

    def _dial(self, peer: _Peer, *, briefly: bool = False) -> None:
        self._dial_at(peer, None)
        left = [e for e in peer.endpoints() if e not in peer.tried]
        if not left:
            peer.tried.clear()
            left = peer.endpoints()
        peer.dialling = tuple(left)
        peer.last_endpoint = left[0]
        peer.attempts += 1
        self._outputs.append(Dial(peer.identity.guid, peer.dialling, briefly))


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
        _foreign(peer),
    )


def _foreign(peer: _Peer) -> TrustReason | None:
    """Why an unlinked peer is not of this mesh, if its last refusal says so."""
    if peer.link is None and peer.refused is not None and peer.refused.code in NOT_OF_THIS_MESH:
        return TrustReason(peer.refused.code)
    return None
