from __future__ import annotations

import pytest

from rmpa.web.gateways.frame_writer import MaskCheck, Opcode, frame_header


@pytest.mark.parametrize(
    ("size", "header"),
    [
        (0, "8100"),
        (125, "817d"),
        (126, "817e007e"),
        (65535, "817effff"),
        (65536, "817f0000000000010000"),
    ],
)
def test_header_of_a_text_frame(size: int, header: str) -> None:
    """The lengths of RFC 6455, section 5.2."""
    assert frame_header(Opcode.TEXT, size).hex() == header


_SIZES = (0, 1, 125, 126, 65535, 65536)


def _masked(size: int) -> bytes:
    header = bytearray(frame_header(Opcode.BINARY, size))
    header[1] |= 0x80
    return bytes(header) + b"mask" + bytes(size)


@pytest.mark.parametrize("step", [1, 3, 1000, 1 << 20])
def test_a_frame_without_a_mask_is_found_wherever_it_begins(step: int) -> None:
    data = b"".join(map(_masked, _SIZES))
    for unmasked in (b"", b"\x81\x00", b"\x81\x7e"):
        check, whole = MaskCheck(), data + unmasked
        passed = [check.passes(whole[at : at + step]) for at in range(0, len(whole), step)]
        assert all(passed) is (unmasked == b"")


def test_a_binary_frame_differs_by_its_opcode() -> None:
    assert frame_header(Opcode.BINARY, 1) == b"\x82\x01"
