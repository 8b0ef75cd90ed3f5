"""Events and outputs of the membership protocol, and the view of a peer."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rmpa.core.identity import Guid, Identity
    from rmpa.discovery.beacon import Address, Beacon


class HeardBy(Enum):
    """How a peer was heard."""

    MULTICAST = "multicast"
    UNICAST = "unicast"
    GOSSIP = "gossip"
    """It answered an announcement to an address that another peer's gossip had."""
    LINK = "link"


class LossReason(Enum):
    """Why a peer is no member any more."""

    SILENCE = "silent for its lease"
    GOODBYE = "said goodbye"
    MOVED = "started anew at another port"
    CONFLICT = "another live peer has its GUID address"


class ConflictKind(Enum):
    """The property that two live peers share, though it must be unique."""

    GUID = "guid"
    OWN_GUID = "own guid"
    NAME = "name"


@dataclass(frozen=True, slots=True)
class PeerFound:
    """A peer has become a member.

    Args:
        identity: As in its beacon or handshake.
        source: Where its first packet came from; ``None`` if a link brought it.
        heard: How it was found.
    """

    identity: Identity
    source: Address | None
    heard: HeardBy

    @property
    def guid(self) -> Guid:
        """The peer's GUID."""
        return self.identity.guid


@dataclass(frozen=True, slots=True)
class PeerChanged:
    """The same run of a peer has another identity: addresses or name have changed."""

    identity: Identity
    previous: Identity

    @property
    def guid(self) -> Guid:
        """The peer's GUID as it is now."""
        return self.identity.guid


@dataclass(frozen=True, slots=True)
class PeerRestarted:
    """Another run of an agent is at the endpoint of ``previous``, which is gone."""

    identity: Identity
    previous: Identity
    source: Address | None

    @property
    def guid(self) -> Guid:
        """The new run's GUID."""
        return self.identity.guid


@dataclass(frozen=True, slots=True)
class PeerLost:
    """A peer is no member any more."""

    identity: Identity
    reason: LossReason

    @property
    def guid(self) -> Guid:
        """The GUID it had."""
        return self.identity.guid


@dataclass(frozen=True, slots=True)
class PeerConflict:
    """Two live peers claim the same GUID address or name. ``str`` says what to do. Reported once until it clears.

    Args:
        kind: What they share.
        identity: The peer that was heard now.
        other: The peer that was there; this agent itself for ``OWN_GUID`` and perhaps for ``NAME``.
    """

    kind: ConflictKind
    identity: Identity
    other: Identity

    def __str__(self) -> str:
        """What happened, where, and what to do."""
        host, port = self.identity.guid.endpoint
        if self.kind is ConflictKind.NAME:
            return (
                f"two modules are named {self.identity.name}: {self.identity.guid} and {self.other.guid}, so rules "
                "and commands that name it may mean either; rename one: rmpa up --name"
            )
        if self.kind is ConflictKind.OWN_GUID:
            what = f"the live peer {self.identity.name} has our own GUID address {host}:{port}"
        else:
            what = f"two live peers share one GUID address {host}:{port}: {self.identity.name} and {self.other.name}"
        return f"{what}; give one of them another --port, or fix the NAT between them"


@dataclass(frozen=True, slots=True)
class RunDoubted:
    """Another run was heard at the address of a linked peer: its link is worth a check, as it may have restarted."""

    identity: Identity
    """The linked run."""


@dataclass(frozen=True, slots=True)
class ConflictCleared:
    """Only one of the two peers of a ``PeerConflict`` over a GUID address is left."""

    kind: ConflictKind
    identity: Identity


Event = PeerFound | PeerChanged | PeerRestarted | PeerLost | PeerConflict | RunDoubted | ConflictCleared


@dataclass(frozen=True, slots=True)
class SendMulticast:
    """Send to the group, on every usable interface."""

    beacon: Beacon


@dataclass(frozen=True, slots=True)
class SendUnicast:
    """Send to one address.

    Args:
        beacon: What is sent.
        address: Where to.
        key: Of a secured mesh: the number of the older group key that the receiver has (its low 16 bits); 0: the
            present one.
    """

    beacon: Beacon
    address: Address
    key: int = 0


Output = SendMulticast | SendUnicast


@dataclass(frozen=True, slots=True)
class PeerView:
    """One peer, for display.

    Args:
        identity: As in its last beacon or handshake.
        since: When it was found, in seconds of the protocol's clock.
        heard: When it was last heard by beacon or had a link, on the same clock.
        found_by: How it was found.
        heard_by: How it was last heard.
        source: Where its last packet came from, if there was one.
        linked: Whether it has a link.
        conflicts: Its conflicts, as texts for the user.
        present: Whether it is a member; ``False`` while a conflict prevents it.
    """

    identity: Identity
    since: float
    heard: float
    found_by: HeardBy
    heard_by: HeardBy
    source: Address | None
    linked: bool
    conflicts: tuple[str, ...]
    present: bool
