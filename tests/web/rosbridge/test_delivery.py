from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import LimitExceeded
from rmpa.web.clients.frame_writer import Opcode
from rmpa.web.rosbridge import limits
from rmpa.web.rosbridge.protocol import Assembler, OpError, split

if TYPE_CHECKING:
    import random

    from rmpa.web.clients.frame_writer import OutFrame


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
