"""Fuzz target: the signed documents of the authority, and the notifications that carry them."""

from __future__ import annotations

import contextlib

import msgspec

from rmpa.core.errors import RemoteProtocolError
from rmpa.trust.permissions import Have

try:
    from rmpa.trust.certificates import DenyList, KeyList, read_document, sign
    from rmpa.trust.packets import GroupKey
    from tests.trust.authority import Authority
except ImportError:  # the extra "trust" is not installed
    SEEDS: list[bytes] = [b""]

    def fuzz(data: bytes) -> None:
        """Nothing reads documents without the library."""

else:
    _LAB, _OTHER = Authority(), Authority()
    _DENY = DenyList().with_name("arm", 1.0).with_name("base", 2.0)
    _KEYS = KeyList(3, (GroupKey(1, bytes(32)), GroupKey(2, b"k" * 32)))
    _OURS = [sign(_DENY, _LAB.key), sign(_KEYS, _LAB.key)]
    SEEDS = [
        b"",
        b"{}",
        b'{"signed":"{}","signature":"AA=="}',
        b'{"signed":' + b"[" * 2000,
        b'{"deny":1,"keys":2,"authority":true}',
        sign(_DENY, _OTHER.key),
        *_OURS,
    ]

    class _Envelope(msgspec.Struct):
        """Around a document: fields of other names are skipped, whatever bytes they hold."""

        signed: str

    def _text(data: bytes) -> str:
        return msgspec.json.decode(data, type=_Envelope).signed

    def fuzz(data: bytes) -> None:
        """A document that our authority signed, byte for byte, or a documented error; nothing else is ever taken."""
        key = _LAB.key.public_key()
        form: type[DenyList | KeyList]
        for form in (DenyList, KeyList):
            try:
                found: object = read_document(data, key, form)
            except RemoteProtocolError as error:
                str(error)
            else:
                text = _text(data)
                if text not in map(_text, _OURS):
                    raise AssertionError(f"{found} was never signed")
        try:
            args = msgspec.json.decode(data)
        except (msgspec.MsgspecError, UnicodeError, RecursionError):
            return
        with contextlib.suppress(msgspec.ValidationError):
            msgspec.convert(args, Have)
