"""Fuzz target: requests, certificates and signed documents, and the notifications that carry these."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

import msgspec

from rmpa.core.errors import RemoteProtocolError
from rmpa.trust.permissions import Have

try:
    from rmpa.trust.certificates import (
        DenyList,
        KeyList,
        ca_public_key,
        make_request,
        read_certificate,
        read_document,
        read_request,
        sign,
    )
    from rmpa.trust.packets import GroupKey
    from tests.trust.authority import WALL, Authority, new_key
except ImportError:  # the extra "trust" is not installed
    SEEDS: list[bytes] = [b""]

    def fuzz(data: bytes) -> None:
        """Nothing can be read without the library."""

else:
    if TYPE_CHECKING:
        from collections.abc import Callable

    _LAB, _OTHER = Authority(), Authority()
    _ARM = _LAB.module("arm")
    _DENY = sign(DenyList().with_name("arm", WALL), _LAB.key)
    _KEYS = sign(KeyList(1, (GroupKey(1, bytes(32)),)), _LAB.key)
    _KEY = ca_public_key(_LAB.certificate)
    _SIGNED = (
        read_certificate(_ARM, _LAB.certificate),
        read_document(_DENY, _KEY, DenyList),
        read_document(_KEYS, _KEY, KeyList),
    )
    SEEDS = [
        b"",
        make_request(new_key(), "arm"),
        *(_ARM, _LAB.certificate, _DENY, _KEYS),
        sign(DenyList().with_name("base", WALL), _OTHER.key),
        b"{}",
        b'{"signed":"{}","signature":"AA=="}',
        b'{"signed":' + b"[" * 2000,
        b'{"deny":1,"keys":2,"authority":true}',
    ]

    def fuzz(data: bytes) -> None:
        """Whatever comes in: a documented error, or what the authority has signed."""
        readers: list[Callable[[], object]] = [
            lambda: read_certificate(data, _LAB.certificate),
            lambda: read_document(data, _KEY, DenyList),
            lambda: read_document(data, _KEY, KeyList),
        ]
        for reader in readers:
            try:
                found = reader()
            except RemoteProtocolError as error:
                str(error)
                continue
            if found not in _SIGNED:
                raise AssertionError(f"{found} was not signed by the authority")
        try:
            read_request(data)
        except RemoteProtocolError as error:
            str(error)
        with contextlib.suppress(msgspec.MsgspecError, UnicodeError, RecursionError):
            msgspec.convert(msgspec.json.decode(data), Have)
