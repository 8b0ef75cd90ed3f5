"""The attachment between sites: golden bytes, and bytes that are none."""

from __future__ import annotations

import pytest

from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway import limits
from rmpa.gateway.sites.keys import AttachmentReader, MessageSource

SOURCE = MessageSource("992ce8a1687cec8c8bd883ec73ca41d1", "/talker", ("warehouse", "cloud"), latched=True)
GOLDEN = (
    bytes.fromhex("01 01 0700000000000000 15cd5b0700000000 992ce8a1687cec8c8bd883ec73ca41d1")
    + b"\x07/talker\x02\x09warehouse\x05cloud"
)


def test_golden_bytes() -> None:
    assert SOURCE.writer()(7, 123456789) == GOLDEN
    assert AttachmentReader().read(GOLDEN) == (7, 123456789, SOURCE)


def test_what_later_versions_add_is_ignored() -> None:
    assert AttachmentReader().read(GOLDEN + b"more")[2] == SOURCE


@pytest.mark.parametrize("length", range(len(GOLDEN)))
def test_a_shorter_one_is_refused(length: int) -> None:
    with pytest.raises(RemoteProtocolError):
        AttachmentReader().read(GOLDEN[:length])


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        (b"\x01\x01\x07", b"\x02\x01\x07", "version 2"),
        (b"/talker", b"talker/", "no global name"),
        (b"/talker", b"/t\xff\xfeker", "not UTF-8"),
        (b"\x02\x09", b"\x00\x09", "passed 0 sites"),
        (b"\x02\x09", b"\xff\x09", "passed 255 sites"),
        (b"cloud", b"cl-ud", "names the site"),
    ],
)
def test_what_ros_does_not_allow_is_refused(old: bytes, new: bytes, problem: str) -> None:
    with pytest.raises(RemoteProtocolError, match=problem):
        AttachmentReader().read(GOLDEN.replace(old, new, 1))


def test_a_loop_is_bounded() -> None:
    path = tuple(f"s{number}" for number in range(limits.PATH_MAX + 1))
    with pytest.raises(RemoteProtocolError, match="sites"):
        AttachmentReader().read(MessageSource("0" * 32, "/n", path).writer()(1, 0))


def test_the_run_is_read_back_and_a_reader_knows_each_source_again() -> None:
    first = SOURCE._replace(run=2**63 - 1)
    second = first._replace(node="/other", latched=False)
    reader = AttachmentReader()
    for number, each in enumerate((first, second, first, second), 1):
        assert reader.read(each.writer()(number, -5)) == (number, -5, each)
    assert first.writer()(7, 123456789) == GOLDEN + (2**63 - 1).to_bytes(8, "little")
