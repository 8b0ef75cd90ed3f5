"""Decides which side dials, when, and which of two links with one peer stays: one machine over all peers.

A peer's place is its address and port; its runs (incarnations) follow each other there. Outputs are collected, and
returned by ``take`` (``PeeringOutput``). Each dial is answered by exactly one of ``link_up``, ``dial_refused`` or
``dial_failed``.

Beacons can be forged. Therefore *unverified* peers, which were never linked, are dialled from a queue, at a rate that
is bounded over all of them. Peers that were linked before are dialled at once.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Generic, Literal, TypeVar

from rmpa.core import limits as core_limits
from rmpa.core.identity import Guid, Identity
from rmpa.core.timers import Backoff, TimerQueue, TokenBucket, earliest
from rmpa.mesh import limits
from rmpa.mesh.frames import FULL, Hello, Lane, Link, Refusal, Refuse, judge
from rmpa.trust.permissions import NOT_OF_THIS_MESH, TrustReason

if TYPE_CHECKING:
    from collections.abc import Callable

_log = logging.getLogger(__name__)

# The higher GUID waits this long for the lower one's dial, then dials itself (NAT, firewall).
DIAL_FALLBACK: Final = 2.0
# Dials a second to all peers together that fell silent (``limits.PURSUIT``), half a millisecond each: 64 peers whose
# network failed at once are dialled every 0.5 s, and take less than a tenth of a core for ten seconds.
PURSUITS_PER_SECOND: Final = 200.0
# After the loss of a link that was up for at least this long, the back-off begins at the shortest delay.
LINK_STABLE: Final = 5.0
# Delay before another dial to a peer that refused for a reason that seldom passes by itself (version, domain).
REFUSED_RETRY: Final = 5.0

# How long the lower GUID refuses the dial of a peer to which it has sent a hello itself: more than a round trip. If
# its own hello is not answered for longer, the peer's dial is accepted.
_CROSSING_TIME: Final = 0.5

SocketAddress = tuple[str, int]

# Refusals without proof of the sender, or that pass once a clock is set: they are shown, and change no pause.
_UNPROVEN: Final = frozenset({TrustReason.UNSECURED, TrustReason.CLOCK})
# Refusals that concern one endpoint only, because another agent, or this agent itself, answered there.
_OTHER_PEER: Final = frozenset({Refusal.MYSELF, Refusal.WRONG_PEER})


_PASSING: Final = frozenset({Refusal.ALREADY_LINKED, Refusal.BUSY, Refusal.NO_EXPRESS})
# Refusals for reasons that seldom pass by themselves.
_SELDOM_MENDED: Final = frozenset({*Refusal, *TrustReason}) - _UNPROVEN - _OTHER_PEER - _PASSING


# Why a link is no longer used: the same run of the peer has another link from the same moment on.
REPLACED: Final = "replaced by a newer link"
# Why a link is no longer used: another run of the peer has taken its place.
RESTARTED: Final = "the peer restarted"
_L = TypeVar("_L", bound=Link)
# What the driver has to do, or the rooms above have to know; see ``Peering.take``.
PeeringOutput = (
    tuple[Literal["dial"], Guid, tuple[SocketAddress, ...], bool]
    | tuple[Literal["close"], _L, str]
    | tuple[Literal["up"], _L]
    | tuple[Literal["down"], _L, str]
    | tuple[Literal["refused"], Identity, Refuse]
)


@dataclass(slots=True)
class Peer(Generic[_L]):
    """What is known of one peer; only the machine changes it.

    It has more than 12 fields: the peer, its link, the present dial, and when and why the next one comes.

    Args:
        run: Its newest run that is known.
        backoff: The pauses between its dials.
        announced: Whether discovery knows the peer.
        verified: Whether it was linked before.
        gone: Whether it is forgotten when its link or dial ends.
        source: The source address of its own beacons.
        good: The endpoint where it was reached last.
        link: The link that is used with it.
        since: When the link came up, or the last link fell, monotonic seconds; ``None`` before the first link.
        dialling: The endpoints of the present dial.
        hello_at: When the present dial sent its hello.
        tried: The endpoints that were dialled since the last pause.
        next_attempt: When it is dialled next, monotonic seconds.
        forget_at: When it is forgotten.
        pursued_until: Until when it is dialled by short attempts.
        attempts: Dials since the last link.
        last_error: Why there is no link, as far as is known; for a linked peer, why its previous link ended.
        refused: The last refusal, if it is one for a reason that seldom passes by itself.
        reported: The codes of the refusals that were reported.
    """

    run: Identity
    backoff: Backoff
    announced: bool = False
    verified: bool = False
    gone: bool = False
    source: str | None = None
    good: SocketAddress | None = None
    link: _L | None = None
    since: float | None = None
    dialling: tuple[SocketAddress, ...] = ()
    hello_at: float | None = None
    tried: set[SocketAddress] = field(default_factory=set)
    next_attempt: float | None = None
    forget_at: float | None = None
    pursued_until: float = -math.inf
    attempts: int = 0
    last_error: str = ""
    refused: Refuse | None = None
    reported: set[int] = field(default_factory=set)

    @property
    def identity(self) -> Identity:
        """The run that is linked, else the newest one."""
        return self.run if self.link is None else self.link.identity

    @property
    def state(self) -> Literal["linked", "dialling", "waiting", "refused"]:
        """``refused``: waiting after a refusal for a reason that seldom passes by itself."""
        if self.link is not None:
            return "linked"
        if self.dialling:
            return "dialling"
        return "waiting" if self.refused is None else "refused"

    @property
    def foreign(self) -> TrustReason | None:
        """Why it is not of this mesh, if its last refusal says so."""
        code = self.refused.code if self.refused is not None and self.link is None else None
        return TrustReason(code) if code in NOT_OF_THIS_MESH else None

    @property
    def has_place(self) -> bool:
        """Whether it is one of the modules of this mesh."""
        return self.link is not None or (self.verified and self.announced)

    def endpoints(self) -> list[SocketAddress]:
        """The endpoints to dial, best first: the last one that worked, the beacon's source, the announced ones."""
        candidates = [self.good] if self.good is not None else []
        if self.source is not None:
            candidates.append((self.source, self.run.guid.port))
        return list(dict.fromkeys([*candidates, *self.run.endpoints]))


class Peering(Generic[_L]):
    """The machine over all peers.

    Args:
        ours: The identity of this agent.
        rng: Uniform numbers in [0, 1), for the jitter.

    Attributes:
        left_out: Whether a mesh that is full has refused this module, and no link has come up since.
    """

    def __init__(self, ours: Identity, *, rng: Callable[[], float]) -> None:
        self._ours = ours
        self._rng = rng
        self._peers: dict[int, Peer[_L]] = {}
        self._outputs: list[PeeringOutput[_L]] = []
        self._timers: TimerQueue[int] = TimerQueue()
        # Unverified peers whose dials are due, the one that has been due longest first.
        self._dial_queue: dict[int, None] = {}
        self._newest_next = True
        self.left_out = False
        self._queue_at: float | None = None
        self._dial_rate = TokenBucket(limits.DIAL_STRANGERS_RATE, limits.DIAL_STRANGERS_BURST)

    def peer_found(self, identity: Identity, now: float, source: str | None = None) -> None:
        """Take in a peer that discovery found, or news of it (new addresses, a restart).

        Args:
            identity: The peer.
            now: Monotonic seconds.
            source: The source address of the peer's own beacon; ``None`` if it was found in another way.
        """
        if identity.instance == self._ours.instance or identity.guid.place == self._ours.guid.place:
            return
        peer = self._peer(identity)
        restarted = peer.run.instance != identity.instance
        fresh = not peer.announced or restarted
        if restarted and identity.guid < peer.run.guid and peer.link is not None:
            return  # an outdated report: the link is with a newer run
        peer.announced, peer.gone, peer.forget_at = True, False, None
        self._set_timer(peer)
        peer.source = source or peer.source
        peer.run = identity
        if restarted:
            self._restart(peer, now)
        if fresh and peer.link is None and not peer.dialling:
            self._dial_at(peer, now + self._fallback(peer))
        self._dial_due(peer, now)
        self._dial_unverified(now)

    def peer_gone(self, guid: Guid) -> None:
        """Stop dialling a peer that discovery has given up. A link that is up stays until it ends by itself."""
        peer = self._peers.get(guid.place)
        if peer is None or peer.run.guid != guid:
            return
        peer.announced, peer.gone = False, True
        self._forget_if_idle(peer)

    def judge(self, hello: Hello, now: float) -> Refuse | None:
        """Decide on a received hello; ``None`` accepts it, and the driver then calls ``link_up``."""
        peer = self._peers.get(hello.guid.place)
        if peer is not None and hello.lane == Lane.EXPRESS and self._crosses(peer, hello, now):
            text = "we dial each other; the link that the lower GUID dials stays"
            return Refuse(Refusal.ALREADY_LINKED, text)
        refuse = judge(hello, self._ours, None if peer is None else peer.link, full=self._full(peer))
        if refuse is FULL:
            self.link_refused(hello.guid, refuse)
        return refuse

    def _full(self, peer: Peer[_L] | None = None) -> bool:
        """Whether the mesh has no place for this peer, or for a new one.

        A place is taken by a link, and kept while its peer is away for a moment: until discovery has given it up.
        """
        if len(self._peers) < limits.MODULES_MAX or (peer is not None and peer.has_place):
            return False
        return sum(each.has_place for each in self._peers.values()) >= limits.MODULES_MAX - 1

    def dial_opened(self, guid: Guid, now: float) -> bool:
        """Take in that a dial has a connection, on which the hello is sent next.

        Returns:
            Whether the connection is still wanted. If not, because the peer's own dial led to a link meanwhile, or
            its link is not stuck, the driver closes it, and this dial is over.
        """
        peer = self._peers.get(guid.place)
        if peer is None or not peer.dialling:
            return True
        if peer.link is None or peer.link.stuck:
            peer.hello_at = now
            return True
        peer.dialling = ()
        return False

    def link_up(self, link: _L, now: float) -> None:
        """Take in a link whose handshake succeeded."""
        identity = link.identity
        peer = self._peer(identity)
        counted = bool(peer.dialling) and not peer.verified
        if link.dialled:
            peer.dialling, peer.hello_at = (), None
            peer.good = link.remote_endpoint
        other, lower = peer.link, self._ours.guid < identity.guid
        same_run = other is not None and other.identity.instance == identity.instance
        if other is not None and same_run and other.dialled != link.dialled and other.dialled == lower:
            # Of two links the one that the lower GUID dialled stays; if the same side dialled both, the newer one.
            self._outputs.append(("close", link, "we are linked already; the lower GUID's link stays"))
            return
        self._replace(peer, REPLACED if same_run else RESTARTED, now)
        if peer.run.instance != identity.instance:
            peer.run = identity
            peer.backoff.reset()
        peer.link, peer.since = link, now
        peer.pursued_until = -math.inf
        peer.forget_at = peer.refused = None
        self._dial_at(peer, None)
        peer.verified = True
        if counted:  # a dial that led to the link does not count against the rate
            self._dial_rate.put_back()
            self._dial_unverified(now)
        peer.attempts = 0
        peer.gone = self.left_out = False
        peer.tried.clear()
        peer.reported.clear()
        self._outputs.append(("up", link))

    def link_silent(self, link: _L) -> None:
        """Try a new connection beside a silent link, as soon as the peer can be reached again, on any path.

        TCP retransmits more and more rarely. The new link replaces this one.
        """
        peer = self._peers.get(link.identity.guid.place)
        if peer is not None and peer.link is link and not peer.dialling:
            self._dial(peer, briefly=True)

    def link_down(self, link: _L, reason: str, now: float, *, silent: bool = False, needed: bool = False) -> None:
        """Handle the end of a link; without effect for a link that was replaced or never up.

        Args:
            link: The link.
            reason: Why, for people.
            now: Monotonic seconds.
            silent: Whether the link ended by silence: the path to the peer failed, and may work again at once.
            needed: Whether something at either side depended on it, so that the peer is worth many attempts.
        """
        peer = self._peers.get(link.identity.guid.place)
        if peer is None or peer.link is not link:
            return
        if silent or now - (peer.since or now) >= LINK_STABLE:
            peer.backoff.reset()
        peer.link, peer.since, peer.last_error = None, now, reason
        self._outputs.append(("down", link, reason))
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
        if not peer.dialling:
            self._dial_at(peer, now + self._pause(peer, now) + self._fallback(peer))

    def dial_failed(self, guid: Guid, error: str, now: float, endpoint: SocketAddress | None = None) -> None:
        """Handle a dial without an answer, or whose connection ended before its handshake was done.

        Args:
            guid: The peer that was dialled.
            error: What happened.
            now: Monotonic seconds.
            endpoint: The endpoint of the connection that ended; ``None`` if no endpoint answered.
        """
        peer = self._dial_ended(guid, endpoint)
        if peer is not None:
            if peer.link is None:
                peer.last_error, peer.refused = error, None
            self._retry(peer, now)

    def dial_refused(
        self, guid: Guid, refuse: Refuse, now: float, endpoint: SocketAddress | None = None, *, proved: bool = True
    ) -> None:
        """Handle a dial that was refused at this endpoint, by either side; without a proof it is only shown."""
        peer = self._dial_ended(guid, endpoint)
        if peer is None or peer.link is not None:
            return
        peer.last_error = str(refuse)
        if refuse.code == Refusal.ALREADY_LINKED:
            # The peer has a link that was lost here (it ends within the lease), or that is about to be accepted here.
            self._dial_at(peer, now + max(limits.EXPRESS_LEASE, self._pause(peer, now)))
            return
        if refuse.code in _UNPROVEN or not proved:
            peer.refused = refuse
        if not proved or refuse.code in _OTHER_PEER or refuse.code not in _SELDOM_MENDED:
            self._retry(peer, now)
        else:
            peer.refused = refuse
            pause = max(REFUSED_RETRY, self._cap(peer))
            self._dial_at(peer, now + pause * (1 + 0.5 * self._rng()))
        full = refuse.code == Refusal.FULL
        reported = self.left_out if full else refuse.code in peer.reported
        if refuse.code not in _OTHER_PEER and not reported:
            peer.reported.add(refuse.code)
            self.left_out |= full
            self._outputs.append(("refused", peer.run, refuse))

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

    def take(self) -> list[PeeringOutput[_L]]:
        """Return the outputs since the last call, in order.

        Returns:
            * ``("dial", guid, endpoints, briefly)``: connect to this peer at the endpoint that answers first, best
              first. With ``briefly`` each gets one short attempt, because the next dial follows soon.
            * ``("close", link, reason)``: send a bye on this link and close it.
            * ``("up", link)``: this link is the one that is used with its peer.
            * ``("down", link, reason)``: the link that was used with its peer is no longer used; the reason is
              ``REPLACED``, ``RESTARTED``, or how its connection ended.
            * ``("refused", identity, refuse)``: a peer refuses links for a reason that was not reported before.
        """
        outputs, self._outputs = self._outputs, []
        return outputs

    def peers(self) -> list[Peer[_L]]:
        """All known peers, by GUID."""
        return sorted(self._peers.values(), key=lambda p: p.run.guid)

    def _peer(self, identity: Identity) -> Peer[_L]:
        """What is known of the peer at this identity's place; a new record if there is none."""
        new: Peer[_L] = Peer(identity, Backoff(limits.BACKOFF_FIRST, limits.BACKOFF_MAX, self._rng))
        return self._peers.setdefault(identity.guid.place, new)

    def _fallback(self, peer: Peer[_L]) -> float:
        """Seconds that this side waits for the peer's dial: none if it has the lower GUID, and dials first."""
        return 0.0 if self._ours.guid < peer.run.guid else DIAL_FALLBACK

    def _forget_if_idle(self, peer: Peer[_L]) -> None:
        """Forget a peer that is gone, unless it has a link or an unanswered dial."""
        peer.forget_at = None
        self._dial_at(peer, None)
        if peer.link is None and not peer.dialling:
            self._peers.pop(peer.run.guid.place, None)

    def _restart(self, peer: Peer[_L], now: float) -> None:
        """Forget the errors and refusals of a peer's former run, because a new run announced itself."""
        peer.backoff.reset()
        peer.tried.clear()
        peer.reported.clear()
        peer.refused = None
        link = peer.link
        if link is None or link.identity.instance == peer.run.instance:
            return
        if link.identity.guid < peer.run.guid or not link.alive:
            self._replace(peer, RESTARTED, now)

    def _crosses(self, peer: Peer[_L], hello: Hello, now: float) -> bool:
        """Whether a hello crosses that of this side, whose link stays.

        The link of the hello would be replaced a round trip later, with the calls that are made over it meanwhile. An
        unverified peer is accepted all the same: a forged beacon may lead this side's dial to an address without an
        answer.
        """
        if self._fallback(peer) or not peer.verified or peer.link is not None or peer.hello_at is None:
            return False
        same_run = peer.run.instance == hello.instance
        return same_run and now - peer.hello_at < _CROSSING_TIME

    def _replace(self, peer: Peer[_L], reason: str, now: float) -> None:
        """Close a peer's link, if there is one: another link replaces it, or another run of the peer."""
        if peer.link is not None:
            self._outputs += [("close", peer.link, reason), ("down", peer.link, reason)]
            peer.link, peer.since = None, now

    def _dial_ended(self, guid: Guid, endpoint: SocketAddress | None) -> Peer[_L] | None:
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
        peer.dialling, peer.hello_at = (), None
        if peer.gone:
            self._forget_if_idle(peer)
            return None
        return peer

    def _retry(self, peer: Peer[_L], now: float) -> None:
        """Try the other endpoints at once, or wait when all were tried."""
        if peer.link is not None:
            self._dial_at(peer, None if peer.link.alive else now + limits.REDIAL_PAUSE)
        elif peer.tried.issuperset(peer.endpoints()):
            peer.tried.clear()
            peer.good = None
            self._dial_at(peer, now + self._pause(peer, now))
        else:
            self._dial_at(peer, now)

    def _cap(self, peer: Peer[_L]) -> float:
        """The longest pause between dials, in seconds: unverified peers share the rate of all of them."""
        if peer.verified:
            return limits.BACKOFF_MAX
        unverified = sum(not each.verified for each in self._peers.values())
        return max(limits.BACKOFF_MAX, unverified / limits.DIAL_STRANGERS_RATE)

    def _pause(self, peer: Peer[_L], now: float) -> float:
        if now < peer.pursued_until:
            pursued = sum(now < each.pursued_until for each in self._peers.values())
            return max(limits.REDIAL_PAUSE, pursued / PURSUITS_PER_SECOND) * (0.5 + self._rng())
        peer.backoff.cap = self._cap(peer)
        return peer.backoff.delay()

    def _set_timer(self, peer: Peer[_L]) -> None:
        place = peer.run.guid.place
        attempt = None if place in self._dial_queue else peer.next_attempt
        self._timers.set(place, earliest(attempt, peer.forget_at))

    def _dial_at(self, peer: Peer[_L], when: float | None) -> None:
        """Set the time of the next dial; ``None``: never."""
        place = peer.run.guid.place
        peer.next_attempt = when
        self._dial_queue.pop(place, None)
        self._set_timer(peer)

    def _dial_due(self, peer: Peer[_L], now: float) -> None:
        """Dial a peer whose dial is due; an unverified one joins the queue instead."""
        due = peer.next_attempt
        if due is None or now < due or peer.dialling:
            return
        if peer.link is not None and peer.link.alive:
            self._dial_at(peer, None)
            return
        if peer.verified:
            self._dial(peer, briefly=peer.link is not None or now < peer.pursued_until)
            return
        self._dial_queue[peer.run.guid.place] = None
        self._set_timer(peer)

    def _dial_unverified(self, now: float) -> None:
        """Dial unverified peers of the queue as far as the rate allows.

        It takes in turn the newest peer that was never dialled, so that a real peer does not wait for many forged
        ones, and the peer that has waited longest, so that no peer waits forever.
        """
        if self._dial_queue and self._full():
            self._queue_at = now + REFUSED_RETRY
            return
        while self._dial_queue and self._dial_rate.take(now):
            queue = [self._peers[place] for place in self._dial_queue]
            newest = next((p for p in reversed(queue) if not p.attempts), None) if self._newest_next else None
            self._newest_next = not self._newest_next
            self._dial(newest or queue[0])
        self._queue_at = self._dial_rate.next(now) if self._dial_queue else None

    def _dial(self, peer: Peer[_L], *, briefly: bool = False) -> None:
        self._dial_at(peer, None)
        left = [e for e in peer.endpoints() if e not in peer.tried]
        if not left:
            peer.tried.clear()
            left = peer.endpoints()
        peer.dialling = tuple(left)
        peer.attempts += 1
        self._outputs.append(("dial", peer.run.guid, peer.dialling, briefly))
