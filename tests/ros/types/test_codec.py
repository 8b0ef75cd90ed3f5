from __future__ import annotations

import base64
import contextlib
import math
import struct
from collections.abc import Mapping
from typing import Any

import cbor2
import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rmpa.core.limits import MIB
from rmpa.ros.types.codec import MessageCodec, codec_for
from rmpa.ros.types.definitions import (
    SEPARATOR,
    DefinitionError,
    Specification,
    parse_definition,
)
from rmpa.ros.types.messages import MessageError, MessageType
from rmpa.ros.types.values import WRITTEN_MAX
from tests.ros.types.genmsg_cases import VALUES, VALUES_OF

NOW_NS = 5_000_000_007


def _codec(text: str) -> MessageCodec:
    return MessageCodec("t/T", parse_definition("t/T", text))


def _json(codec: MessageCodec, payload: bytes) -> Any:
    return msgspec.json.decode(codec.json(memoryview(payload)))


def _cbor(codec: MessageCodec, payload: bytes) -> Any:
    return cbor2.loads(cbor2.dumps(codec.cbor_values(memoryview(payload))))


def _with_base64(values: Any, known: Mapping[str, Specification], name: str) -> Any:
    """The values as JSON has them: arrays of bytes in base64."""
    made = dict(values)
    for field in known[name].fields:
        if field.array and field.type in ("uint8", "char"):
            made[field.name] = base64.b64encode(bytes(values[field.name])).decode()
        elif not field.primitive:
            inner = values[field.name]
            each = [_with_base64(item, known, field.type) for item in (inner if field.array else [inner])]
            made[field.name] = each if field.array else each[0]
    return made


def test_json_of_all_kinds_of_fields() -> None:
    codec = _codec(
        "uint8[] blob\nchar[2] pair\nint8[] small\nbyte level\nbool yes\nbool[] many\nint64 big\nfloat64 real\n"
        "float32[] list\nstring text\nstring[] texts\ntime t\nduration[] ds\nt/P p\nt/P[2] ps\nt/E e\n"
        f"{SEPARATOR}\nMSG: t/P\nint16 x\nint16 y\n{SEPARATOR}\nMSG: t/E\nuint8 CONSTANT=7\n"
    )
    raw = (
        b"\x03\0\0\0\x00\xff\x10" + b"AB" + b"\x02\0\0\0\xff\x01" + b"\xfe" + b"\x01" + b"\x02\0\0\0\x00\x01"
        + struct.pack("<q", -(2**63)) + struct.pack("<d", math.inf)
        + b"\x02\0\0\0" + struct.pack("<ff", math.nan, 0.5)
        + b"\x03\0\0\0\xe2\x82\xac" + b"\x02\0\0\0" + b"\x01\0\0\0a" + b"\0\0\0\0"
        + struct.pack("<II", 4_000_000_000, 9) + b"\x01\0\0\0" + struct.pack("<ii", -1, -2)
        + struct.pack("<hhhhhh", 1, -2, 3, 4, 5, 6)
    )  # fmt: skip
    assert codec.json(memoryview(raw)) == (
        b'{"blob":"AP8Q","pair":"QUI=","small":[-1,1],"level":-2,"yes":true,"many":[false,true],'
        b'"big":-9223372036854775808,"real":null,"list":[null,0.5],"text":"\xe2\x82\xac","texts":["a",""],'
        b'"t":{"secs":4000000000,"nsecs":9},"ds":[{"secs":-1,"nsecs":-2}],"p":{"x":1,"y":-2},'
        b'"ps":[{"x":3,"y":4},{"x":5,"y":6}],"e":{}}'
    )
    got = _cbor(codec, raw)
    assert got["blob"] == b"\x00\xff\x10"
    assert got["pair"] == b"AB"
    assert got["real"] == math.inf
    assert got["small"] == cbor2.CBORTag(72, b"\xff\x01")
    assert got["list"] == cbor2.CBORTag(85, struct.pack("<ff", math.nan, 0.5))
    assert got["many"] == [False, True]
    assert codec.write(got, NOW_NS).payload == raw


@pytest.mark.parametrize(
    ("kind", "tag", "code"),
    [
        ("uint16", 69, "H"), ("uint32", 70, "I"), ("uint64", 71, "Q"), ("int8", 72, "b"), ("byte", 72, "b"),
        ("int16", 77, "h"), ("int32", 78, "i"), ("int64", 79, "q"), ("float32", 85, "f"), ("float64", 86, "d"),
    ],
)  # fmt: skip
def test_arrays_have_the_tags_of_the_specification(kind: str, tag: int, code: str) -> None:
    codec = _codec(f"{kind}[] a")
    raw = struct.pack(f"<I3{code}", 3, 1, 2, 3)
    assert _cbor(codec, raw) == {"a": cbor2.CBORTag(tag, raw[4:])}
    assert codec.write(_cbor(codec, raw), 0).payload == raw
    assert _json(codec, raw) == {"a": [1, 2, 3]}


def _one_nan(value: float) -> float:
    """CBOR's half-precision NaN has no room for the other bits that a NaN may have."""
    return math.nan if math.isnan(value) else value


_SCALARS: dict[str, st.SearchStrategy[Any]] = {
    "bool": st.booleans(),
    "int8": st.integers(-128, 127),
    "uint8": st.integers(0, 255),
    "char": st.integers(0, 255),
    "byte": st.integers(-128, 127),
    "int16": st.integers(-(2**15), 2**15 - 1),
    "uint32": st.integers(0, 2**32 - 1),
    "int64": st.integers(-(2**63), 2**63 - 1),
    "uint64": st.integers(0, 2**64 - 1),
    "float32": st.floats(width=32, allow_infinity=False).map(_one_nan),
    "float64": st.floats(allow_infinity=False).map(_one_nan),
    "string": st.text(st.characters(exclude_categories=["Cs"])),
    "time": st.fixed_dictionaries({"secs": st.integers(0, 2**32 - 1), "nsecs": st.integers(0, 2**32 - 1)}),
    "duration": st.fixed_dictionaries({"secs": st.integers(-(2**31), 2**31 - 1), "nsecs": st.just(-5)}),
}


@st.composite
def _messages(draw: st.DrawFn) -> tuple[str, dict[str, Any]]:
    """The text of a type with two levels, and values of it."""
    texts: list[str] = []
    strategies: list[st.SearchStrategy[dict[str, Any]]] = []
    for inner in (True, False):
        lines, fields = [], {}
        kinds = draw(st.lists(st.sampled_from([*_SCALARS] + ([] if inner else ["t/I"] * 4)), min_size=1, max_size=6))
        for number, kind in enumerate(kinds):
            one = strategies[0] if kind == "t/I" else _SCALARS[kind]
            suffix = draw(st.sampled_from(["", "", "[]", "[3]"]))
            count = {"[]": (0, 4), "[3]": (3, 3)}.get(suffix)
            fields[f"f{number}"] = one if count is None else st.lists(one, min_size=count[0], max_size=count[1])
            lines.append(f"{kind}{suffix} f{number}")
        texts.append("\n".join(lines))
        strategies.append(st.fixed_dictionaries(fields))
    return f"{texts[1]}\n{SEPARATOR}\nMSG: t/I\n{texts[0]}\n", draw(strategies[1])


@settings(max_examples=150, deadline=None)
@given(_messages())
def test_any_message_of_any_type_makes_the_round_trip(made: tuple[str, dict[str, Any]]) -> None:
    text, values = made
    codec = _codec(text)
    payload = codec.write(values, 0).payload
    # Bytes are compared: NaN is not equal to itself. null stands for NaN, whose bits may differ.
    again = codec.write(_cbor(codec, payload), 0).payload
    assert again == payload
    assert codec.json(memoryview(codec.write(_json(codec, payload), 0).payload)) == codec.json(memoryview(payload))


@settings(max_examples=150, deadline=None)
@given(_messages(), st.data())
def test_cut_and_changed_bytes_are_an_error_or_a_message(
    made: tuple[str, dict[str, Any]], data: st.DataObject
) -> None:
    text, values = made
    codec = _codec(text)
    payload = bytearray(codec.write(values, 0).payload)
    for _ in range(data.draw(st.integers(0, 3))):
        if payload:
            payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.sampled_from([0, 1, 0x7F, 0xFF]))
    cut = memoryview(payload)[: data.draw(st.integers(0, len(payload)))]
    for convert in (codec.json, codec.cbor_values):
        with contextlib.suppress(MessageError):
            convert(cut)


@pytest.mark.parametrize(
    ("text", "raw"),
    [
        ("string s", b"\xff\xff\xff\xffabc"), ("float64[] a", b"\xff\xff\xff\xff" + bytes(80)),
        ("string[] a", b"\xff\xff\xff\xff" + bytes(80)), ("time[] a", b"\xff\xff\xff\x7f"),
        (f"t/E[] a\n{SEPARATOR}\nMSG: t/E\n", b"\xff\xff\xff\xff"),
        (f"t/E[] a\n{SEPARATOR}\nMSG: t/E\nstring s", b"\xff\xff\xff\xff" + bytes(80)),
        (f"t/E[] a\n{SEPARATOR}\nMSG: t/E\nint8 s", b"\xff\xff\xff\xff" + bytes(80)), ("int8 a", b""),
        ("int8 a", b"\0\0"), ("float64[900000] a", b"\0"),
    ],
)  # fmt: skip
def test_bytes_that_claim_too_much_are_refused_at_once(text: str, raw: bytes) -> None:
    codec = _codec(text)
    for convert in (codec.json, codec.cbor_values):
        with pytest.raises(MessageError, match=f"{len(raw)} bytes are not a t/T"):
            convert(memoryview(raw))


def test_definitions_that_grow_without_bytes_are_refused() -> None:
    blocks = [f"{SEPARATOR}\nMSG: t/L{level}\nt/L{level + 1}[1000] a" for level in range(6)]
    text = "t/L0 a\n" + "\n".join(blocks) + f"\n{SEPARATOR}\nMSG: t/L6\n"
    with pytest.raises(DefinitionError, match="values"):
        _codec(text)
    with pytest.raises(DefinitionError, match="bytes"):
        _codec("uint8[999999999] a")


@pytest.mark.parametrize("element", [{}, {"c": 1}])
def test_defaults_cannot_fill_the_memory(element: dict[str, int]) -> None:
    codec = _codec(f"t/B[] a\n{SEPARATOR}\nMSG: t/B\nuint8[{15 * MIB}] b\nint8 c")
    with pytest.raises(MessageError, match=f"longer than {WRITTEN_MAX}"):
        codec.write({"a": [element] * 20}, 0)


def test_a_string_that_is_not_utf_8_is_readable() -> None:
    assert _json(_codec("string s"), b"\x03\0\0\0a\xffb") == {"s": "a\N{REPLACEMENT CHARACTER}b"}


def test_a_missing_header_or_stamp_is_now() -> None:
    codec = codec_for(MessageType("geometry_msgs/PoseStamped"))
    made = codec.write({}, NOW_NS)
    assert _json(codec, made.payload)["header"] == {"seq": 0, "stamp": {"secs": 5, "nsecs": 7}, "frame_id": ""}
    assert made.missing == ["pose"]
    given = codec.write({"header": {"frame_id": "map"}, "pose": {"position": {}, "orientation": {}}}, NOW_NS)
    stamp = {"secs": 5, "nsecs": 7}
    assert _json(codec, given.payload)["header"] == {"seq": 0, "stamp": stamp, "frame_id": "map"}
    kept = codec.write({"header": {"stamp": {"secs": 0, "nsecs": 0}}}, NOW_NS)
    assert _json(codec, kept.payload)["header"]["stamp"] == {"secs": 0, "nsecs": 0}


def test_byte_arrays_are_taken_as_base64_lists_and_bytes() -> None:
    codec = _codec("uint8[] a")
    raw = b"\x03\0\0\0\x01\x02\xff"
    for value in (base64.b64encode(raw[4:]).decode(), [1, 2, 255], raw[4:], cbor2.CBORTag(64, raw[4:])):
        assert codec.write({"a": value}, 0).payload == raw


@pytest.mark.parametrize(("values", "raw"), VALUES)
def test_values_have_the_bytes_of_genpy(values: dict[str, Any], raw: str) -> None:
    codec = _codec(VALUES_OF)
    if not raw:
        with pytest.raises(MessageError, match=f": {min(values)}.*: does not fit"):
            codec.write(values, 0)
        return
    assert codec.write(values, 0).payload.hex() == raw
    assert codec.write(_cbor(codec, bytes.fromhex(raw)), 0).payload.hex() == raw


def test_null_is_not_a_number() -> None:
    codec = _codec("float64 a\nfloat32[] b")
    payload = codec.write({"a": None, "b": [1.5, None]}, 0).payload
    assert _json(codec, payload) == {"a": None, "b": [1.5, None]}


@pytest.mark.parametrize(
    ("value", "says"),
    [
        ({"x": 1, "z": 1}, "t/T has no field 'z'; it has x, s, a, b, p, h"),
        ({"x": 128}, "x: does not fit int8: 128"), ({"x": True}, "x: is a int8, not True"),
        ({"x": 1.5}, "x: is a int8, not 1.5"), ({"x": 10**5000}, "x: does not fit int8: an integer of 16610 bits"),
        ({"s": 1}, "s: is a string, not 1"), ({"s": "\ud800"}, "s: has half of a surrogate pair"),
        ({"a": [1, 2]}, "a: has 3 elements"), ({"a": [1, 2, "3"]}, r"a\[2\]: is a float32, not '3'"),
        ({"a": [1, 2, 1e300]}, r"a\[2\]: does not fit float32"),
        ({"a": "AAAA"}, r"a: is a list \(float32\[3\]\), not 'AAAA'"),
        ({"b": "not base64!"}, r"b: is base64 \(uint8\[\]\)"), ({"b": [256]}, r"b\[0\]: does not fit uint8: 256"),
        ({"a": bytes(12)}, r"a: is a list \(float32\[3\]\), not 12 bytes"),
        ({"p": [{"y": 1}, {"y": []}]}, r"p\[1\].y: is a int16, not a list of 0"),
        ({"p": {}}, r"p: is a list \(t/P\[\]\), not an object of 0 fields"),
        ({"h": {"secs": "1"}}, "h: is a time, not '1'"), ({"h": {"secs": -1}}, "h: does not fit a time"),
        ([1], r"is a t/T \(an object\), not a list of 1"), (None, r"is a t/T \(an object\), not None"),
    ],
)  # fmt: skip
def test_a_wrong_value_is_named_with_its_place(value: Any, says: str) -> None:
    codec = _codec(f"int8 x\nstring s\nfloat32[3] a\nuint8[] b\nt/P[] p\ntime h\n{SEPARATOR}\nMSG: t/P\nint16 y")
    with pytest.raises(MessageError, match=f"^t/T: {says}"):
        codec.write(value, 0)


def test_arguments_are_an_object_or_the_fields_in_order() -> None:
    codec = _codec("int8 a\nint8 b")
    for arguments in ([1, 2], {"b": 2, "a": 1}):
        assert codec.write_arguments(arguments, 0).payload == b"\x01\x02"
    nothing: Any
    for nothing in ([], None, {}):
        assert codec.write_arguments(nothing, 0).payload == b"\0\0"
    for wrong in ([1, 2, 3], "1", 5):
        with pytest.raises(MessageError):
            codec.write_arguments(wrong, 0)
