"""What a partial write leaves: every cut of every part."""

from __future__ import annotations

from rmpa.runtime.tls import Buffer, unsent

PARTS: list[Buffer] = [b"ab", b"", memoryview(b"cde"), bytearray(b"f")]
WHOLE = b"abcdef"


def test_each_cut_leaves_the_rest() -> None:
    for sent in range(len(WHOLE) + 1):
        left = unsent(PARTS, sent)
        assert b"".join(left) == WHOLE[sent:]
        assert all(len(part) for part in left[1:]) or sent == 0


def test_whole_parts_are_not_copied() -> None:
    assert unsent(PARTS, 2)[-1] is PARTS[-1]
