"""Events and outputs of the failure detector, and its view of a member."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rmpa.core.guid import Guid
    from rmpa.discovery.beacon import Address
    from rmpa.discovery.swim.packets import MemberState, SwimPacket


@dataclass(frozen=True, slots=True)
class MemberSuspected:
    """A member did not answer this agent's probes, or those of another one; it may refute that it has failed."""

    guid: Guid
    instance: bytes


@dataclass(frozen=True, slots=True)
class MemberRefuted:
    """A suspected member is alive."""

    guid: Guid
    instance: bytes


@dataclass(frozen=True, slots=True)
class MemberFailed:
    """A member is not watched any more, because it did not refute a suspicion in time."""

    guid: Guid
    instance: bytes


@dataclass(frozen=True, slots=True)
class MemberLeft:
    """A member is not watched any more, because it said that it leaves."""

    guid: Guid
    instance: bytes


@dataclass(frozen=True, slots=True)
class MemberOffers:
    """A newer version of what a member offers was heard of."""

    guid: Guid
    instance: bytes
    version: int


@dataclass(frozen=True, slots=True)
class MemberHeardOf:
    """A run that is not watched here answers probes: an announcement to it is worthwhile, if it is no member yet.

    Args:
        guid: Its GUID.
        run: The first ``RUN_BYTES`` of its instance id.
    """

    guid: Guid
    run: bytes


SwimEvent = MemberSuspected | MemberRefuted | MemberFailed | MemberLeft | MemberOffers | MemberHeardOf


@dataclass(frozen=True, slots=True)
class SendSwim:
    """Send a packet to one address."""

    packet: SwimPacket
    address: Address


@dataclass(frozen=True, slots=True)
class MemberView:
    """One watched member, for display.

    Args:
        state: Alive or suspect.
        incarnation: How often it refuted a suspicion.
        version: The version of what it offers.
        heard: Monotonic seconds of its last packet; ``None`` if none came.
        rtt: The last round trip of a probe, in seconds; ``None`` before the first.
    """

    state: MemberState
    incarnation: int
    version: int
    heard: float | None
    rtt: float | None


@dataclass(frozen=True, slots=True)
class DetectorView:
    """The state of a failure detector, for display.

    Args:
        active: Whether it probes.
        members: The members that it watches.
        suspects: Those that are suspected now.
        health: Its score of its own health; 0 is well, ``limits.HEALTH_MAX`` the worst.
        incarnation: How often this agent refuted a suspicion.
        version: The version of what this agent offers.
        news: News that is being spread.
    """

    active: bool
    members: int
    suspects: int
    health: int
    incarnation: int
    version: int
    news: int
