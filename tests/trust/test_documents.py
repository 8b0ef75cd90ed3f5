"""Signed documents, and the notifications that carry them."""

from __future__ import annotations

import msgspec
import pytest
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from hypothesis import given
from hypothesis import strategies as st

from rmpa.bridge.messages import Notification, decode, encode
from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.trust import limits
from rmpa.trust.certificates import DenyEntry, DenyList, KeyList, read_document, sign
from rmpa.trust.packets import GroupKey
from rmpa.trust.permissions import HAVE, Document, Have
from tests.trust.authority import WALL, Authority, new_key

pytest.importorskip("cryptography")


LAB = Authority()
PUBLIC = LAB.key.public_key()
DENY = DenyList(7, (DenyEntry("arm", 1_790_000_000), DenyEntry("base", 5)))
KEYS = KeyList(3, (GroupKey(2, b"a" * 32), GroupKey(3, b"b" * 32)), "base", proves_from=3, made=1_790_000_000)


def _signed(text: str, label: bytes = b"rmpa deny 1", key: ec.EllipticCurvePrivateKey = LAB.key) -> bytes:
    signature = key.sign(label + b"\x00" + text.encode(), ec.ECDSA(hashes.SHA256()))
    return msgspec.json.encode({"signed": text, "signature": signature})


def test_documents_survive_their_round_trip() -> None:
    assert read_document(sign(DENY, LAB.key), PUBLIC, DenyList) == DENY
    assert read_document(sign(KEYS, LAB.key), PUBLIC, KeyList) == KEYS
    assert KEYS.keys == (GroupKey(2, b"a" * 32), GroupKey(3, b"b" * 32))


def test_the_text_is_golden() -> None:
    envelope = msgspec.json.decode(sign(DENY, LAB.key))
    assert envelope["signed"] == (
        '{"number":7,"entries":[{"name":"arm","before":1790000000},{"name":"base","before":5}]}'
    )
    assert set(envelope) == {"signed", "signature"}
    assert read_document(_signed(envelope["signed"]), PUBLIC, DenyList) == DENY
    assert msgspec.json.decode(sign(KEYS, LAB.key))["signed"] == (
        '{"number":3,"keys":[{"number":2,"key":"YWFhYWFhYWFhYWFhYWFhYWFhYWFhYWFhYWFhYWFhYWE="},'
        '{"number":3,"key":"YmJiYmJiYmJiYmJiYmJiYmJiYmJiYmJiYmJiYmJiYmI="}],"authority":"base",'
        '"proves_from":3,"made":1790000000}'
    )


def test_keys_of_later_versions_are_ignored() -> None:
    text = '{"number":1,"entries":[{"name":"arm","before":5,"why":"lost"}],"mesh":"lab"}'
    assert read_document(_signed(text), PUBLIC, DenyList) == DenyList(1, (DenyEntry("arm", 5),))


def test_every_changed_byte_is_refused() -> None:
    document = sign(DENY, LAB.key)
    for offset in range(len(document)):
        changed = document[:offset] + bytes([document[offset] ^ 1]) + document[offset + 1 :]
        try:
            found = read_document(changed, PUBLIC, DenyList)
        except RemoteProtocolError:
            continue
        assert found == DENY, offset  # a spare bit of the signature's base64


def test_other_signers_and_other_kinds_are_refused() -> None:
    with pytest.raises(RemoteProtocolError, match="not signed by our authority"):
        read_document(sign(DENY, new_key()), PUBLIC, DenyList)
    with pytest.raises(RemoteProtocolError, match="not signed by our authority"):
        read_document(sign(KEYS, LAB.key), PUBLIC, DenyList)
    with pytest.raises(RemoteProtocolError, match="not signed by our authority"):
        read_document(sign(DENY, LAB.key), PUBLIC, KeyList)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        '{"entries":5}',
        '{"number":-1}',
        '{"number":4294967296}',
        '{"number":1,"entries":[{"name":"my arm","before":5}]}',
        '{"number":1,"entries":[{"name":"arm"}]}',
    ],
)
def test_signed_nonsense_is_refused(text: str) -> None:
    with pytest.raises(RemoteProtocolError):
        read_document(_signed(text), PUBLIC, DenyList)


@pytest.mark.parametrize(
    "keys",
    [
        "[]",
        '[{"number":1,"key":"AAAA"}]',
        '[{"number":0,"key":"' + "A" * 43 + '="}]',
        '[{"number":1,"key":"' + "A" * 43 + '="},{"number":1,"key":"' + "A" * 43 + '="}]',
        "[" + ",".join(f'{{"number":{n},"key":"' + "A" * 43 + '="}' for n in range(1, 10)) + "]",
    ],
)
def test_key_lists_that_cannot_be_are_refused(keys: str) -> None:
    with pytest.raises(RemoteProtocolError):
        read_document(_signed('{"number":1,"keys":' + keys + "}", b"rmpa keys 1"), PUBLIC, KeyList)


def test_an_authority_with_a_name_that_cannot_be_is_refused() -> None:
    with pytest.raises(RemoteProtocolError, match="authority"):
        read_document(sign(KeyList(3, KEYS.keys, "my base"), LAB.key), PUBLIC, KeyList)


def test_long_documents_are_refused_before_they_are_read() -> None:
    with pytest.raises(LimitExceeded):
        read_document(b" " * (limits.DOCUMENT_MAX + 1), PUBLIC, DenyList)


def test_a_full_list_fits() -> None:
    full = DenyList(1, tuple(DenyEntry(f"{'m' * 58}{n:06}", 1_790_000_000) for n in range(limits.DENY_MAX)))
    document = sign(full, LAB.key)
    assert len(document) <= limits.DOCUMENT_MAX
    assert read_document(document, PUBLIC, DenyList) == full
    with pytest.raises(ValueError, match="at most 1024 names"):
        full.with_name("one_more", WALL)


def test_revoking_counts_up_and_replaces() -> None:
    once = DenyList().with_name("arm", 100.9)
    twice = once.with_name("arm", 200.0)
    assert (once.number, once.entries) == (1, (DenyEntry("arm", 100),))
    assert (twice.number, twice.entries) == (2, (DenyEntry("arm", 200),))
    assert twice.denies("arm", 200.0)
    assert not twice.denies("arm", 201.0)
    assert not twice.denies("base", 100.0)
    assert twice.with_name("arm", 150.0).denies("arm", 200.0)  # the clock went back
    with pytest.raises(ValueError, match="not a ROS base name"):
        once.with_name("my arm", 1.0)


def test_secrets_are_never_shown() -> None:
    assert "GroupKey(2), GroupKey(3)" in repr(KEYS)
    assert "aaa" not in repr(KEYS) + str(KEYS)


@given(st.binary(max_size=200))
def test_anything_at_all_is_refused(data: bytes) -> None:
    form: type[DenyList | KeyList]
    for form in (DenyList, KeyList):
        with pytest.raises(RemoteProtocolError):
            read_document(data, PUBLIC, form)


def test_golden_bytes_of_the_notifications() -> None:
    for have, golden in (
        (Have(7, 3), b'{"op":"tell","what":"trust.have","args":{"deny":7,"keys":3}}'),
        (Have(7, 3, True), b'{"op":"tell","what":"trust.have","args":{"deny":7,"keys":3,"authority":true}}'),
    ):
        assert encode(Notification(HAVE, msgspec.to_builtins(have))) == golden
        message = decode(golden)
        assert isinstance(message, Notification)
        assert msgspec.convert(message.args, Have) == have
    golden = b'{"op":"tell","what":"trust.deny","args":{"document":"{}"}}'
    assert encode(Notification(Document.DENY.notice, {"document": "{}"})) == golden


@pytest.mark.parametrize(
    "args",
    [
        {},
        {"deny": 1},
        {"deny": -1, "keys": 1},
        {"deny": True, "keys": 1},
        {"deny": "1", "keys": 1},
        {"deny": 1 << 32, "keys": 1},
    ],
)
def test_malformed_notifications_are_refused(args: dict[str, object]) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(args, Have)
