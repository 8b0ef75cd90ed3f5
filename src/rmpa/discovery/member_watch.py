"""Joins the failure detector and the membership protocol: what is watched, and what a failure leads to. Sans-I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.discovery.events import LossReason, PeerFound, PeerLost, PeerRestarted
from rmpa.discovery.swim.events import MemberFailed, MemberHeardOf, MemberLeft

if TYPE_CHECKING:
    from rmpa.core.guid import Guid
    from rmpa.core.identity import Identity
    from rmpa.discovery.endpoint import PeerInstance
    from rmpa.discovery.events import Event
    from rmpa.discovery.membership import MembershipProtocol
    from rmpa.discovery.swim.events import SwimEvent
    from rmpa.discovery.swim.failure_detector import FailureDetector


class MemberWatch:
    """Watches the members that are known to answer probes: by the handshake of a link, by a packet, or by news.

    A peer becomes a member by its own beacon or link alone, as without the failure detector. A run that has failed is
    no member any more, unless it has a link. A peer of an earlier release does not answer probes and is not watched:
    its link, and the lease of its beacons, show whether it is alive.

    Args:
        detector: The failure detector.
        membership: The membership protocol, whose leases the detector renews.
    """

    def __init__(self, detector: FailureDetector, membership: MembershipProtocol) -> None:
        self._detector = detector
        self._membership = membership

    def link_up(self, identity: Identity, now: float, *, answers_probes: bool) -> None:
        """A link with a member is up; the membership protocol knows it already."""
        peer = self._membership.member(identity.guid, identity.instance)
        if peer is not None and (answers_probes or self._detector.knows(identity.instance)):
            self._add(peer, now, linked=True)

    def link_down(self, guid: Guid, instance: bytes | None) -> None:
        """A member's link has fallen."""
        if instance is not None:
            self._detector.set_linked(guid, instance, linked=False)

    def membership_changed(self, event: Event, now: float) -> None:
        """Take in an event of the membership protocol."""
        match event:
            case PeerFound(identity=identity):
                self._add_if_known(identity, now)
            case PeerRestarted(identity=identity, previous=previous):
                self._detector.remove(previous.guid, previous.instance, now)
                self._add_if_known(identity, now)
            case PeerLost(identity=identity, reason=reason):
                left = reason is LossReason.GOODBYE
                self._detector.remove(identity.guid, identity.instance, now, left=left)
            case _:
                pass

    def events(self, now: float) -> list[SwimEvent]:
        """What the failure detector has found, each once; the membership protocol is updated by it."""
        events = self._detector.events()
        for event in events:
            match event:
                case MemberFailed(guid=guid, instance=instance):
                    self._membership.peer_failed(guid, instance, now)
                case MemberLeft(guid=guid, instance=instance):
                    self._membership.peer_failed(guid, instance, now, LossReason.GOODBYE)
                case MemberHeardOf(guid=guid, run=run):
                    peer = self._membership.member(guid, run)
                    if peer is not None:
                        self._add(peer, now, linked=peer.linked)
                    else:
                        self._membership.hear_of((guid,), now)
                case _:
                    pass
        return events

    def _add_if_known(self, identity: Identity, now: float) -> None:
        if self._detector.knows(identity.instance):
            peer = self._membership.member(identity.guid, identity.instance)
            if peer is not None:
                self._add(peer, now, linked=peer.linked)

    def _add(self, peer: PeerInstance, now: float, *, linked: bool) -> None:
        self._detector.add(peer.identity, now, peer.source, linked=linked)
