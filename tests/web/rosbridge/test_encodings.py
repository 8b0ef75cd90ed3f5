"""Encodings and fragments of rosbridge."""

from __future__ import annotations

import base64
import io
import json
import struct
import zlib
from typing import TYPE_CHECKING, Any

import cbor2
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.ros.types.codec import codec_for
from rmpa.ros.types.messages import MessageType
from rmpa.web import limits as web_limits
from rmpa.web.hub.frame_writer import Opcode, OutFrame
from rmpa.web.hub.topics import MadeOnce
from rmpa.web.pictures import png_chunk
from rmpa.web.rosbridge import limits
from rmpa.web.rosbridge.protocol import (
    Assembler,
    Compression,
    OpError,
    data_of,
    decode_png,
    encode_cbor_raw,
    encode_message,
    encode_png,
    split,
)

if TYPE_CHECKING:
    import random


pillow = pytest.importorskip("PIL.Image", reason="pillow, which checks pictures, comes with the extra lab")
STRING = codec_for(MessageType("std_msgs/String"))
HELLO = memoryview(b"\x05\0\0\0hello")


def _pixels(text: str) -> bytes:
    """The pixels of a picture, by another decoder."""
    with pillow.open(io.BytesIO(base64.b64decode(text))) as picture:
        assert picture.mode == "RGB"
        return np.asarray(picture).tobytes()


@pytest.mark.parametrize(
    ("compression", "data"),
    [
        (Compression.NONE, b'{"op":"publish","topic":"/c","msg":{"data":"hello"}}'),
        (
            Compression.CBOR,
            bytes.fromhex(
                "a3"  # a map of 3
                "626f70 677075626c697368"  # op: publish
                "65746f706963 622f63"  # topic: /c
                "636d7367 a1 6464617461 6568656c6c6f"  # msg: {data: hello}
            ),
        ),
    ],
)
def test_golden_bytes(compression: Compression, data: bytes) -> None:
    frame = encode_message("/c", HELLO, compression, STRING)
    assert (frame[0] is Opcode.BINARY, data_of(frame)) == (compression is Compression.CBOR, data)


def test_cbor_raw_bytes() -> None:
    frame = encode_cbor_raw("/c", HELLO, 1_700_000_000_000_000_005)
    assert frame[0] is Opcode.BINARY
    assert bytes(data_of(frame)) == bytes.fromhex(
        "a3 626f70 677075626c697368 65746f706963 622f63 636d7367"
        "a3 6473656373 1a6553f100 656e73656373 05 656279746573 49 0500000068656c6c6f"
    )


@pytest.mark.parametrize("size", [0, 1, 23, 24, 255, 256, 65535, 65536, 70_000])
def test_cbor_raw_of_any_size_is_read_by_another_decoder_and_is_not_copied(size: int) -> None:
    payload = memoryview(bytes(size))
    frame = encode_cbor_raw("/c", payload, 3_000_000_009)
    assert frame[1][-1] is payload
    want = {"op": "publish", "topic": "/c", "msg": {"secs": 3, "nsecs": 9, "bytes": bytes(size)}}
    assert cbor2.loads(bytes(data_of(frame))) == want


def test_each_message_is_encoded_once_for_all_clients(monkeypatch: pytest.MonkeyPatch) -> None:
    frames: MadeOnce[list[str]] = MadeOnce(1000, lambda _: 100)
    first = frames.get(HELLO, lambda: ["made"], "/a", Compression.CBOR)
    assert frames.get(HELLO, lambda: ["made"], "/a", Compression.CBOR) is first
    assert frames.get(HELLO, lambda: ["made"], "/a", Compression.NONE) is not first
    assert frames.get(HELLO, lambda: ["made"], "/b", Compression.CBOR) is not first
    assert frames.get(memoryview(bytes(HELLO)), lambda: ["made"], "/a", Compression.CBOR) is not first


def test_what_is_kept_of_messages_is_bounded() -> None:
    frames: MadeOnce[int] = MadeOnce(1000, lambda made: made)
    for size in (2000, *[100] * 6):
        frames.get(memoryview(bytes(100)), lambda made=size: made)  # type: ignore[misc]
    assert 0 < frames.bytes <= 1000
    for number in range(web_limits.MADE_KEPT * 2):
        frames.get(HELLO, lambda: 0, number)
    assert len(frames._kept) <= web_limits.MADE_KEPT


@pytest.mark.parametrize("size", [0, 1, 2, 3, 4, 11, 12, 13, 100, 4099])
def test_a_png_is_read_by_another_decoder(size: int) -> None:
    text = json.dumps({"op": "x", "data": "é" * size})
    _, (part,) = encode_png(text.encode())
    op = msgspec.json.decode(part)
    assert op["op"] == "png"
    pixels = _pixels(op["data"])
    assert json.loads(pixels) == json.loads(text)
    assert pixels.rstrip(b"\n") == text.encode()
    assert json.loads(decode_png(op["data"])) == json.loads(text)


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L"])
@settings(max_examples=25, deadline=None)
@given(st.data())
def test_pictures_of_another_encoder_are_read(mode: str, data: st.DataObject) -> None:
    channels = {"RGB": 3, "RGBA": 4, "L": 1}[mode]
    width, height = data.draw(st.integers(1, 9)), data.draw(st.integers(1, 9))
    text = data.draw(st.text(st.characters(max_codepoint=127), min_size=0, max_size=width * height * channels))
    raw = text.ljust(width * height * channels).encode()
    file = io.BytesIO()
    pillow.frombytes(mode, (width, height), raw).save(file, "png")
    assert decode_png(base64.b64encode(file.getvalue()).decode()) == raw.decode()


def _picture(
    lines: bytes, width: int, height: int, *, bits: int = 8, packed: bytes | None = None, more: bytes = b""
) -> str:
    head = struct.pack(">IIBBBBB", width, height, bits, 2, 0, 0, 0)
    raw = b"\x89PNG\r\n\x1a\n" + png_chunk(b"IHDR", head) + more
    raw += png_chunk(b"IDAT", zlib.compress(lines) if packed is None else packed)
    return base64.b64encode(raw + png_chunk(b"IEND", b"")).decode()


@pytest.mark.parametrize(
    ("picture", "says"),
    [
        ("no base64!", "base64"),
        ("AAAA", "no PNG"),
        (_picture(b"", 1, 1)[:40], "ends too early"),
        (_picture(bytes(4), 1, 1, bits=16), "8 bits"),
        (_picture(b"", 0xFFFFFFFF, 0xFFFFFFFF), "exceeds the limit"),
        (_picture(b"", 1, 1, packed=b"nonsense"), "unpacked"),
        (_picture(bytes(4), 2, 1), "unpacked"),
        (_picture(b"\x05abc", 1, 1), "unpacked"),
        # Another header, of a larger picture, behind the one that is bounded.
        (
            _picture(b"", 1, 1, more=png_chunk(b"IHDR", struct.pack(">IIBBBBB", 99, 99, 8, 2, 0, 0, 0))),
            "unpacked",
        ),
        (_picture(b"\x00\xff\xff\xff", 1, 1), "UTF-8"),
    ],
)
def test_hostile_pictures_are_refused(picture: str, says: str) -> None:
    with pytest.raises(RemoteProtocolError, match=says):
        decode_png(picture)


def test_a_bomb_is_unpacked_up_to_its_picture_only() -> None:
    # 100 MB of zeros in a picture of one pixel: what is beyond the pixel is never unpacked.
    assert decode_png(_picture(bytes(100_000_000), 1, 1)) == "\0\0\0"


def _text(*parts: bytes) -> OutFrame:
    return Opcode.TEXT, parts


def test_fragments_in_bytes() -> None:
    (_, first), (_, second) = split(_text(b'{"op":', b'"x"}'), 6, "i")
    assert first == (b'{"op":"fragment","id":"i","data":"{\\"op\\":","num":0,"total":2}',)
    assert second == (b'{"op":"fragment","id":"i","data":"\\"x\\"}","num":1,"total":2}',)


def test_what_fits_and_what_is_binary_stays_whole() -> None:
    binary = Opcode.BINARY, (b"12345",)
    for frame, size in ((_text(b"12345"), 5), (binary, 1), (_text("ééé".encode()), 3)):
        assert split(frame, size, 1) == [frame]


@given(st.text(st.characters(exclude_categories=["Cs"]), min_size=1), st.integers(1, 20), st.randoms())
def test_fragments_come_together_in_any_order(text: str, size: int, rng: random.Random) -> None:
    frames = split(_text(text.encode()), size, 7)
    if len(frames) == 1:
        return
    assembler = Assembler()
    ops: list[Any] = [msgspec.json.decode(part) for _, (part,) in frames]
    assert all(len(op["data"]) <= size for op in ops)
    rng.shuffle(ops)
    ops.insert(1, ops[0])  # a repeated one
    results = [assembler.add("fragment", 7, op["num"], op["total"], op["data"], 0) for op in ops]
    assert results[-1] == text
    assert not any(results[:-1])
    assert assembler.next_timer() is None


def test_more_fragments_than_allowed_are_not_made() -> None:
    with pytest.raises(OpError, match="ask for a fragment_size of 2 or more"):
        split(_text(b"x" * (limits.FRAGMENTS_MAX + 1)), 1, 1)


@pytest.mark.parametrize(("num", "total"), [(-1, 2), (2, 2), (0, 0), (0, -1)])
def test_impossible_numbers_are_refused(num: int, total: int) -> None:
    with pytest.raises(OpError, match="cannot be"):
        Assembler().add("fragment", "i", num, total, "x", 0)


def test_totals_that_disagree_drop_the_message() -> None:
    assembler = Assembler()
    assembler.add("fragment", "i", 0, 2, "x", 0)
    with pytest.raises(OpError, match="disagree"):
        assembler.add("fragment", "i", 1, 3, "x", 0)
    assert assembler.next_timer() is None


def test_incomplete_messages_are_bounded_in_number_and_bytes() -> None:
    assembler = Assembler()
    with pytest.raises(LimitExceeded):
        assembler.add("fragment", "i", 0, limits.FRAGMENTS_MAX + 1, "x", 0)
    for number in range(limits.FRAGMENTED_MESSAGES_MAX * 3):
        assembler.add("fragment", number, 0, 2, "x", 0)
    assert len(assembler._messages) == limits.FRAGMENTED_MESSAGES_MAX
    third = "x" * (limits.FRAGMENTED_MAX // 3)
    for number in range(10):
        assembler.add("fragment", f"big{number}", 0, 2, third, 0)
        assert assembler._bytes <= limits.FRAGMENTED_MAX
    for number in range(2):
        assembler.add("fragment", "long", number, 5, third, 0)
    with pytest.raises(LimitExceeded):
        assembler.add("fragment", "long", 2, 5, third, 0)
    assert assembler._bytes <= limits.FRAGMENTED_MAX
    assert assembler._bytes == sum(each.size for each in assembler._messages.values())


def test_the_message_that_waited_longest_is_dropped_first() -> None:
    assembler = Assembler()
    for number in range(limits.FRAGMENTED_MESSAGES_MAX):
        assembler.add("fragment", number, 0, 3, "a", 0)
    assembler.add("fragment", 0, 1, 3, "b", 1)
    assembler.add("fragment", "new", 0, 3, "a", 2)
    assert assembler.add("fragment", 0, 2, 3, "c", 3) == "abc"
    assembler.add("fragment", 1, 1, 3, "b", 4)
    assert assembler.add("fragment", 1, 2, 3, "c", 4) is None


def test_a_message_whose_next_fragment_is_overdue_is_dropped() -> None:
    assembler = Assembler()
    assembler.add("fragment", "a", 0, 3, "x", 0)
    assembler.add("fragment", "a", 1, 3, "y", 10)
    assert assembler.next_timer() == 10 + limits.FRAGMENT_TIMEOUT
    assert not list(assembler.expire(9 + limits.FRAGMENT_TIMEOUT))
    assert list(assembler.expire(10 + limits.FRAGMENT_TIMEOUT)) == ["a"]
    assert assembler.add("fragment", "a", 2, 3, "z", 80) is None
