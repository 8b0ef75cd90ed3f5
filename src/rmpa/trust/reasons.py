"""The reasons for which a secured mesh refuses a connection: one word each, for wire, counters, commands and logs."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from rmpa.core.errors import RemoteProtocolError


class TrustReason(IntEnum):
    """Why a connection is refused; the numbers continue those of ``mesh.handshake.Refusal`` on the wire."""

    PLAIN = 11
    """The dialler does not use TLS, and this mesh does."""
    UNSECURED = 12
    """The acceptor has not joined a secured mesh, and the dialler has."""
    KEY = 13
    """The group key of its packets is unknown."""
    CLOCK = 14
    """A certificate begins in the future."""
    FOREIGN = 15
    """The certificate is of another CA."""
    EXPIRED = 16
    """The certificate's time is over."""
    REVOKED = 17
    """The certificate is on the deny list."""
    NAME = 18
    """The certificate is of another module than the hello says."""
    DOWNGRADE = 19
    """The connection does not use TLS 1.3 with this protocol."""

    @property
    def label(self) -> str:
        """The word for people and counters: ``expired``."""
        return self.name.lower()

    @property
    def remedy(self) -> str:
        """What to do, as a sentence part."""
        return _REMEDIES[self]


_REMEDIES: Final = {
    TrustReason.PLAIN: "it joins by rmpa trust join TOKEN, with a token of rmpa trust invite at the authority",
    TrustReason.UNSECURED: "it joins by rmpa trust join TOKEN, with a token of rmpa trust invite at the authority",
    TrustReason.KEY: "are both of one mesh? the one that was away for long: rmpa trust renew there",
    TrustReason.CLOCK: "set both clocks: date, timedatectl",
    TrustReason.FOREIGN: "they have joined different meshes: rmpa trust join on one, with a token of the other's",
    TrustReason.EXPIRED: "rmpa trust renew on the module whose certificate it is, while the authority is reachable",
    TrustReason.REVOKED: "it can come back by rmpa trust invite at the authority, and rmpa trust join there",
    TrustReason.NAME: "start the module with the name that it joined with, or let it join again",
    TrustReason.DOWNGRADE: "install the same release of rmpa on both",
}


NOT_OF_THIS_MESH: Final = {
    TrustReason.PLAIN: "it has joined a secured mesh and this module has not; join it by rmpa trust join TOKEN here, "
    "with a token of rmpa trust invite at the authority of that mesh",
    TrustReason.UNSECURED: "it has not joined this secured mesh; let it join by rmpa trust invite at the authority "
    "and rmpa trust join TOKEN there",
    TrustReason.FOREIGN: "it has joined another secured mesh; to have both in one, rmpa trust leave and rmpa trust "
    "join TOKEN there, with a token of the authority here",
    TrustReason.KEY: "its group key is unknown here; if it has joined another mesh, rmpa trust leave and rmpa trust "
    "join TOKEN there; if it is of this one, rmpa trust renew here",
}
"""Why a module is not of this mesh, and what to do; behind a semicolon, as for ``Check.from_message``."""


def not_of_this_mesh(reason: TrustReason) -> str:
    """``not of this mesh: it has not joined this secured mesh; let it join by …``."""
    return f"not of this mesh: {NOT_OF_THIS_MESH[reason]}"


class TrustError(RemoteProtocolError):
    """A secured mesh refuses a connection, a certificate or a request.

    Args:
        reason: The word for it.
        text: What is wrong.
    """

    def __init__(self, reason: TrustReason, text: str) -> None:
        super().__init__(text)
        self.reason = reason
