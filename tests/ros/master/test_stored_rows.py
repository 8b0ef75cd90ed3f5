from __future__ import annotations

import math
from datetime import datetime
from typing import TYPE_CHECKING, Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.ros import limits
from rmpa.ros.master.parameters import Parameters
from rmpa.ros.master.stored_rows import NODE, PARAM, NotStorableError, changed_params, packed, param_key, read
from rmpa.ros.master.unverified import NodeRecord
from rmpa.ros.wire.xmlrpc_writer import legal_text

if TYPE_CHECKING:
    from rmpa.ros.master.stored_rows import Key

TALKER = NodeRecord(
    "http://127.0.0.1:4001/",
    {"/chatter": "std_msgs/String"},
    {"/tf": "*"},
    {"/talker/get_loggers": "rosrpc://127.0.0.1:4002"},
    {"/speed/": None},
)

texts = st.text(max_size=20).filter(lambda text: legal_text(text) == text)
scalars = (
    st.booleans()
    | st.integers(-(1 << 31), (1 << 31) - 1)
    | st.floats(allow_nan=False)
    | texts
    | st.binary(max_size=20)
    | st.datetimes(datetime(1970, 1, 1), datetime(2100, 1, 1))  # noqa: DTZ001 - XML-RPC's have no zone
)
values = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(texts, inner, max_size=5),
    max_leaves=20,
)
trees = st.dictionaries(texts, values, max_size=5)


def apply(rows: dict[Key, bytes], before: Any, after: Any) -> None:
    for path, value in changed_params(before, after):
        if value is None:
            del rows[param_key(path)]
        else:
            rows[param_key(path)] = packed(value)


def table(rows: dict[Key, bytes]) -> list[tuple[str, str, bytes]]:
    return [(*key, value) for key, value in rows.items()]


def test_golden_rows() -> None:
    assert TALKER.serialize() == (
        b'{"api":"http://127.0.0.1:4001/","publishers":{"/chatter":"std_msgs/String"},"subscribers":{"/tf":"*"},'
        b'"services":{"/talker/get_loggers":"rosrpc://127.0.0.1:4002"},"params":{"/speed/":null}}'
    )
    assert param_key(("robot", "speed")) == (PARAM, '["robot","speed"]')
    assert packed([1, 2.5, "x", b"\0", True]) == bytes.fromhex("95 01 cb4004000000000000 a178 c40100 c3")
    assert packed({"a": []}) == bytes.fromhex("81 a161 90")


def test_nodes_come_back() -> None:
    kept = read([(NODE, "/talker", TALKER.serialize())])
    assert kept.nodes == {"/talker": TALKER}
    assert kept.lost == []


@given(st.lists(trees, min_size=1, max_size=5))
def test_whatever_the_parameters_were_and_become_the_rows_say_the_same(history: list[Any]) -> None:
    rows: dict[Key, bytes] = {}
    before: Any = {}
    for after in history:
        apply(rows, before, after)
        before = after
    found = read(table(rows))
    assert found.lost == []
    assert found.tree == history[-1]


def test_only_changes_are_reported() -> None:
    parameters = Parameters()
    parameters.set("/", {"a": {"x": 1, "y": [1]}, "b": {"z": "old"}, "empty": {}})
    before = parameters.tree
    parameters.set("/a/x", 2)
    parameters.delete("/b/z")
    assert dict(changed_params(before, parameters.tree)) == {("a", "x"): 2, ("b", "z"): None, ("b",): {}}
    assert list(changed_params(parameters.tree, parameters.tree)) == []
    before = parameters.tree
    parameters.set("/a", "a value in the namespace's place")
    assert dict(changed_params(before, parameters.tree)) == {
        ("a", "x"): None,
        ("a", "y"): None,
        ("a",): "a value in the namespace's place",
    }


def test_long_lists_and_names_with_slashes_come_back() -> None:
    tree = {
        "long": list(range(100_000)),
        "deep": [[[]], [[1.5] * 300, {"k": datetime(2020, 1, 2)}]],  # noqa: DTZ001
        "a/b": {"": 1, "x\ny": math.inf},
    }
    rows: dict[Key, bytes] = {}
    apply(rows, {}, tree)
    assert read(table(rows)).tree == tree


def test_unwritable_values_are_refused() -> None:
    with pytest.raises(NotStorableError, match="OverflowError"):
        packed(1 << 70)
    with pytest.raises(NotStorableError):
        packed(object())  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("kind", "name", "value"),
    [
        ("other", "x", b""),
        (NODE, "/x", b"not json"),
        (NODE, "/x", b'{"api": 5}'),
        (NODE, "/x", b'{"api": "rosrpc://h:1"}'),
        (NODE, "x", b'{"api": "http://h:1/"}'),
        (NODE, "/x", b'{"api": "http://h:1/", "publishers": {"t": "a/b"}}'),
        (NODE, "/" + "x" * limits.CORE_STATE_NAME_MAX, b'{"api": "http://h:1/"}'),
        (NODE, "/x", b'{"api": "http://h:1/", "publishers": {"/t": "a/b\\u0007"}}'),
        (PARAM, '["\\u0007"]', b"\x01"),
        (PARAM, '["a"]', b"\xa1\x07"),
        (PARAM, '["a"]', b"\x81\xa1\x07\x01"),
        (PARAM, "[]", b"\x01"),
        (PARAM, '["a", 1]', b"\x01"),
        (PARAM, "x", b"\x01"),
        (PARAM, '["a"]', b""),
        (PARAM, '["a"]', b"\xc0"),
        (PARAM, '["a"]', b"\xcf\xff\xff\xff\xff\xff\xff\xff\xff"),
        (PARAM, '["a"]', b"\x81\x01\x01"),
        (PARAM, '["a"]', b"\xc7\x01\x05x"),
        (PARAM, '["a"]', b"\x91" * 5000 + b"\x01"),
        (PARAM, '["good"]', b"\x02"),
        (PARAM, '["good", "below"]', b"\x02"),
    ],
)
def test_a_bad_row_is_left_out_and_named(kind: str, name: str, value: bytes) -> None:
    kept = read([(PARAM, '["good"]', b"\x01"), (kind, name, value), (NODE, "/talker", TALKER.serialize())])
    assert kept.tree == {"good": 1}
    assert kept.nodes == {"/talker": TALKER}
    assert len(kept.lost) == 1
    assert len(kept.lost[0]) < 1000


@given(st.lists(st.tuples(st.sampled_from([NODE, PARAM]), st.text(max_size=20), st.binary(max_size=60)), max_size=5))
def test_whatever_rows_there_are_they_are_read(rows: list[tuple[str, str, bytes]]) -> None:
    read(rows)


@given(st.recursive(st.none() | scalars, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner)))
def test_any_node_row_is_read(value: object) -> None:
    row = msgspec.json.encode(value)
    for name in read([(NODE, "/x", row)]).nodes:
        assert name == "/x"
