"""How signed documents reach every module: which linked peer lacks which document (docs/design/trust.md).

Each module tells a new link the numbers of its documents (``trust.have``); the side with a higher number sends that
document, deny list first. A module that takes a newer one sends it on to all that are not known to have it. So a
document is everywhere after as many trips as the mesh is wide, and in a mesh that was split once it is whole again.
"""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.limits import UINT32_MAX

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping


class Notice(StrEnum):
    """The notifications between two agents; the value is their name on the wire."""

    HAVE = "trust.have"
    """``{"deny": 7, "keys": 3}``: the numbers that the sender has; ``"authority": true`` at the authority."""
    DENY = "trust.deny"
    """``{"document": TEXT}``: the signed deny list."""
    KEYS = "trust.keys"
    """Likewise: the signed list of group keys."""


DOCUMENTS: Final = (Notice.DENY, Notice.KEYS)
"""The documents in the order in which they are sent: a module that was revoked gets no new key."""


class DocumentSpreading:
    """Knows what each linked peer has.

    Args:
        number: The number of the document that this module has.
    """

    def __init__(self, number: Callable[[Notice], int]) -> None:
        self._number = number
        self._known: dict[int, dict[Notice, int]] = {}

    def link_up(self, peer: int) -> None:
        """A peer is linked; it has not said what it has."""
        self._known[peer] = {}

    def link_down(self, peer: int) -> None:
        """A peer is not linked any more."""
        self._known.pop(peer, None)

    def have(self, peer: int, numbers: Mapping[Notice, int]) -> tuple[Notice, ...]:
        """A peer said what it has; return the documents that it is to be sent."""
        known = self._known.get(peer)
        if known is None:
            return ()
        for kind, number in numbers.items():
            known[kind] = max(number, known.get(kind, 0))
        return self._take(peer, DOCUMENTS)

    def received(self, peer: int, kind: Notice, number: int) -> None:
        """A peer sent a valid document, so it has it."""
        known = self._known.get(peer)
        if known is not None:
            known[kind] = max(number, known.get(kind, 0))

    def changed(self) -> list[tuple[int, tuple[Notice, ...]]]:
        """This module has newer documents: each peer that is known to lack some, and which."""
        return [(peer, lacking) for peer in list(self._known) if (lacking := self._take(peer, DOCUMENTS))]

    def _take(self, peer: int, kinds: tuple[Notice, ...]) -> tuple[Notice, ...]:
        """The documents that a peer lacks; they count as sent."""
        known = self._known[peer]
        lacking = tuple(kind for kind in kinds if kind in known and known[kind] < self._number(kind))
        for kind in lacking:
            known[kind] = self._number(kind)
        return lacking


def have_args(number: Callable[[Notice], int], *, is_authority: bool) -> dict[str, Any]:
    """The arguments of ``trust.have``."""
    args: dict[str, Any] = {kind.removeprefix("trust."): number(kind) for kind in DOCUMENTS}
    return args | {"authority": True} if is_authority else args


def read_have(args: Mapping[str, Any]) -> tuple[dict[Notice, int], bool]:
    """The numbers that a peer has, and whether it is the authority.

    Raises:
        RemoteProtocolError: They are malformed.
    """
    numbers = {kind: args.get(kind.removeprefix("trust.")) for kind in DOCUMENTS}
    checked = {
        kind: number
        for kind, number in numbers.items()
        if isinstance(number, int) and not isinstance(number, bool) and 0 <= number <= UINT32_MAX
    }
    if len(checked) != len(numbers):
        raise RemoteProtocolError("trust.have without the numbers of two documents")
    return checked, args.get("authority") is True


def read_document(args: Mapping[str, Any]) -> bytes:
    """The document in ``trust.deny`` or ``trust.keys``.

    Raises:
        RemoteProtocolError: There is none.
    """
    text = args.get("document")
    if not isinstance(text, str):
        raise RemoteProtocolError("a notification without its document")
    return text.encode()
