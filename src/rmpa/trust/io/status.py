"""Builds the state that ``rmpa trust status``, the snapshot and ``/diagnostics`` show."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.trust import limits
from rmpa.trust.status import MemberInfo, TokenInfo, TrustStatus
from rmpa.trust.tokens import fingerprint_of

if TYPE_CHECKING:
    from collections.abc import Collection

    from rmpa.trust.io.authority import MeshAuthority
    from rmpa.trust.io.membership import Membership
    from rmpa.trust.tokens import Invitation


def status_of(
    membership: Membership,
    authority: MeshAuthority | None = None,
    *,
    agent: str = "off",
    linked: Collection[str] | None = None,
    authority_name: str = "",
) -> TrustStatus:
    """The state of a member.

    Args:
        membership: The member.
        authority: What it has as the authority; ``None``: it is not.
        agent: As in the result.
        linked: The names of the linked modules; ``None``: the agent does not run.
        authority_name: The authority's name; empty: as the files say.
    """
    certificate, deny = membership.certificate, membership.deny
    place = None if authority is not None else membership.store.load_authority()
    name = membership.name if authority is not None else authority_name or (place.name if place is not None else "")
    wall = membership.wall()
    return TrustStatus(
        on=True,
        module=membership.name,
        folder=str(membership.store.folder),
        agent=agent,
        is_authority=authority is not None,
        authority=name,
        fingerprint=fingerprint_of(membership.files.ca).hex(),
        issued=int(certificate.issued),
        expires=int(certificate.expires),
        renew_at=int(certificate.renew_at),
        clock_set=wall is not None,
        key=membership.ring.newest.number,
        deny_number=deny.number,
        revoked=tuple(sorted(entry.name for entry in deny.entries)),
        members=_members(membership, authority, linked),
        tokens=tuple(_token(each, wall) for each in authority.book.invitations) if authority is not None else (),
        problems=problems_of(membership, name),
    )


def problems_of(membership: Membership, authority_name: str = "") -> tuple[str, ...]:
    """What the user should do something about."""
    wall, certificate = membership.wall(), membership.certificate
    if wall is None:
        text = "this machine's clock is not set: it shows a time before the certificate was issued"
        return (f"{text}, so times of certificates and packets are not checked; set it (timedatectl)",)
    if membership.deny.denies(membership.name, certificate.issued):
        remedy = "if it is to come back: rmpa trust invite at the authority, rmpa trust join here"
        return (f"this module was revoked (deny list {membership.deny.number}); {remedy}",)
    left = certificate.expires - wall
    where = f"the authority {authority_name}" if authority_name else "the authority"
    if left <= 0:
        return (f"the certificate of {membership.name} has ended: no link comes up until {where} renews it",)
    if left <= limits.EXPIRY_NEAR:
        text = f"the certificate of {membership.name} ends in {left / 3600:.0f} h, and could not be renewed"
        return (f"{text}: is {where} running and reachable?",)
    return ()


def _members(
    membership: Membership, authority: MeshAuthority | None, linked: Collection[str] | None
) -> tuple[MemberInfo, ...]:
    if authority is None:
        return ()
    return tuple(
        MemberInfo(
            name=each.name,
            issued=each.issued,
            expires=each.expires,
            linked=None if linked is None else each.name in linked or each.name == membership.name,
        )
        for each in authority.issued
    )


def _token(invitation: Invitation, wall: float | None) -> TokenInfo:
    ended = wall is not None and wall >= invitation.expires
    state = "used" if invitation.used_by else "ended" if ended else "open"
    return TokenInfo(
        id=invitation.token_id.hex(),
        state=state,
        expires=invitation.expires,
        name=invitation.name,
        used_by=invitation.used_by,
    )
