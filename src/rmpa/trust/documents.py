"""Signed, numbered documents of the authority: the deny list and the list of group keys (docs/design/trust.md).

A document is the JSON object ``{"signed": TEXT, "signature": BASE64}``: TEXT is a JSON object too, and the signature
(ECDSA P-256, SHA-256, DER) is over the kind's label, a zero byte and TEXT. So it can be checked before TEXT is
parsed, and no document can stand for one of the other kind. Of two documents the one with the higher number holds.
"""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Final, TypeVar

import msgspec
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec

from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.identity import peer_name_problem
from rmpa.core.limits import UINT32_MAX
from rmpa.trust import limits
from rmpa.trust.keyring import GroupKey

if TYPE_CHECKING:
    from collections.abc import Iterable

_ALGORITHM: Final = ec.ECDSA(hashes.SHA256())


class DocumentKind(StrEnum):
    """What a document is; the value is the label under its signature."""

    DENY = "rmpa deny 1"
    KEYS = "rmpa keys 1"


class DocumentError(RemoteProtocolError):
    """A document is malformed, or not signed by the authority."""


class _Signed(msgspec.Struct, frozen=True):
    signed: str
    signature: bytes


class DenyEntry(msgspec.Struct, frozen=True):
    """One revoked module.

    Args:
        name: The module's.
        before: Certificates of that name that were issued up to this time are refused; seconds since 1970.
    """

    name: str
    before: int


class DenyList(msgspec.Struct, frozen=True):
    """The names that were revoked.

    Args:
        number: Grows with each change; 0: nothing was ever revoked.
        entries: One for each name.
    """

    number: int = 0
    entries: tuple[DenyEntry, ...] = ()

    def denies(self, name: str, issued: float) -> bool:
        """Whether a certificate is refused.

        Args:
            name: The module that it is of.
            issued: When it was issued, seconds since 1970.
        """
        return any(entry.name == name and issued <= entry.before for entry in self.entries)

    def with_name(self, name: str, wall: float) -> DenyList:
        """The list after a revocation.

        Args:
            name: The module, whose present certificates are all refused.
            wall: When the last of them was issued, or later; seconds since 1970. The time of an entry never goes
                back.

        Raises:
            ValueError: No module can have that name, or the list is full.
        """
        if problem := peer_name_problem(name):
            raise ValueError(problem)
        before = max([int(wall), *(entry.before for entry in self.entries if entry.name == name)])
        entries = (*(entry for entry in self.entries if entry.name != name), DenyEntry(name, before))
        if len(entries) > limits.DENY_MAX:
            raise ValueError(f"a deny list has at most {limits.DENY_MAX} names; make a new mesh (rmpa trust init)")
        return DenyList(self.number + 1, entries)


class _KeyEntry(msgspec.Struct, frozen=True):
    number: int
    key: bytes

    def __repr__(self) -> str:
        return f"_KeyEntry({self.number})"


class KeyList(msgspec.Struct, frozen=True):
    """The group keys of a mesh. It is secret: only members get it, over their links.

    Args:
        number: Grows with each change.
        keys: By number.
        authority: The name of the authority, so that no other member can pass for it; empty: not known.
        proves_from: The number of the key that the last revocation made: a revoked module has those before.
        made: When the newest key was made, by the authority's clock in seconds since 1970; 0: it was not set.
    """

    number: int
    keys: tuple[_KeyEntry, ...]
    authority: str = ""
    proves_from: int = 0
    made: int = 0

    @classmethod
    def of(
        cls, number: int, keys: Iterable[GroupKey], authority: str = "", *, proves_from: int = 0, made: int = 0
    ) -> KeyList:
        """The list of these keys; arguments as for the class."""
        entries = tuple(_KeyEntry(key.number, key.secret) for key in keys)
        return cls(number, entries, authority, proves_from, made)

    @property
    def group_keys(self) -> tuple[GroupKey, ...]:
        """The keys."""
        return tuple(GroupKey(entry.number, entry.key) for entry in self.keys)

    def __repr__(self) -> str:
        """The numbers alone: secrets never come into a log."""
        return f"KeyList(number={self.number}, keys={[entry.number for entry in self.keys]})"


_T = TypeVar("_T", DenyList, KeyList)


def sign(document: DenyList | KeyList, key: ec.EllipticCurvePrivateKey) -> bytes:
    """A document with the CA's signature, as it is sent and stored."""
    kind = DocumentKind.DENY if isinstance(document, DenyList) else DocumentKind.KEYS
    text = msgspec.json.encode(document).decode()
    return msgspec.json.encode(_Signed(text, key.sign(_under_signature(kind, text), _ALGORITHM)))


def read_deny_list(data: bytes, key: ec.EllipticCurvePublicKey) -> DenyList:
    """Read a signed deny list.

    Args:
        data: As ``sign`` made it.
        key: The CA's key.

    Raises:
        LimitExceeded: It is too long.
        DocumentError: It is malformed, or not signed with that key.
    """
    found = _read(data, key, DocumentKind.DENY, DenyList)
    if len(found.entries) > limits.DENY_MAX:
        raise DocumentError(f"{len(found.entries)} names on a deny list")
    for entry in found.entries:
        if problem := peer_name_problem(entry.name):
            raise DocumentError(problem)
    return found


def read_key_list(data: bytes, key: ec.EllipticCurvePublicKey) -> KeyList:
    """Read a signed list of group keys; arguments and errors as for ``read_deny_list``."""
    found = _read(data, key, DocumentKind.KEYS, KeyList)
    if not 0 < len(found.keys) <= limits.KEYS_MAX:
        raise DocumentError(f"{len(found.keys)} group keys")
    if found.authority and (problem := peer_name_problem(found.authority)):
        raise DocumentError(problem)
    try:
        numbers = [each.number for each in found.group_keys]
    except ValueError as error:
        raise DocumentError(str(error)) from None
    if len(set(numbers)) != len(numbers):
        raise DocumentError("two group keys of one number")
    return found


def _read(data: bytes, key: ec.EllipticCurvePublicKey, kind: DocumentKind, form: type[_T]) -> _T:
    if len(data) > limits.DOCUMENT_MAX:
        raise LimitExceeded("a signed document", len(data), limits.DOCUMENT_MAX)
    try:
        envelope = msgspec.json.decode(data, type=_Signed)
        key.verify(envelope.signature, _under_signature(kind, envelope.signed), _ALGORITHM)
        document = msgspec.json.decode(envelope.signed, type=form)
    except InvalidSignature:
        raise DocumentError("the document is not signed by our authority") from None
    except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise DocumentError(f"the document cannot be read: {error!s:.200}") from None
    if not 0 <= document.number <= UINT32_MAX:
        raise DocumentError(f"the document's number is {document.number}")
    return document


def _under_signature(kind: DocumentKind, text: str) -> bytes:
    return kind.value.encode() + b"\x00" + text.encode()
