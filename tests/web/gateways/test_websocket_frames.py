from __future__ import annotations

import pytest

from rmpa.web.gateways.websocket_frames import Opcode, frame_header


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


def test_a_binary_frame_differs_by_its_opcode() -> None:
    assert frame_header(Opcode.BINARY, 1) == b"\x82\x01"
