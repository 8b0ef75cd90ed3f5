"""Fuzz target: the attachments of messages between sites and of ROS 2, and small documents of sites."""

from __future__ import annotations

import msgspec

from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway.ros2.format import Ros2Attachment
from rmpa.gateway.sites.keys import AttachmentReader, MessageSource
from rmpa.gateway.sites.services import read_description
from rmpa.ros.wire.tcpros import ServiceDescription

_MD5 = "992ce8a1687cec8c8bd883ec73ca41d1"
SEEDS: list[bytes] = [
    b"",
    Ros2Attachment(1, 2**40, bytes(range(16))).serialize(),
    Ros2Attachment(-1, 0, bytes(24)).serialize() + b"later",
    MessageSource(_MD5, "/talker", ("warehouse",), latched=True).writer()(1, 2**40),
    MessageSource(_MD5, "/ns/node", ("a", "b", "c")).writer()(2**63, 0),
    MessageSource(_MD5, "/talker", ("yard",), run=7).writer()(5, 0),
    msgspec.json.encode(ServiceDescription("std_srvs/Trigger", _MD5)),
    b"{}",
]


def fuzz(data: bytes) -> None:
    """What is read is written as it was, but for bytes behind it; all else is a RemoteProtocolError."""
    try:
        read = Ros2Attachment.parse(data)
        if Ros2Attachment.parse(read.serialize()) != read:
            raise AssertionError(f"{read} does not survive its bytes")
    except RemoteProtocolError as error:
        _check_text(error)
    try:
        sequence, stamp, source = AttachmentReader().read(data)
        if AttachmentReader().read(source.writer()(sequence, stamp)) != (sequence, stamp, source):
            raise AssertionError(f"{source} does not survive its bytes")
    except RemoteProtocolError as error:
        _check_text(error)
    try:
        read_description(data)
    except RemoteProtocolError as error:
        _check_text(error)


def _check_text(error: RemoteProtocolError) -> None:
    if not str(error).isprintable():
        raise AssertionError("an error's text is not safe to log")
