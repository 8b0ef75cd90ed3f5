"""Fuzz target: headers of publishers of other sites, and ``rmpa why`` of gateways."""

from __future__ import annotations

import msgspec

from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway.sites.topic_header import TopicHeader
from rmpa.gateway.sites.why import SourceThere, WhyAnswer, WhyQuestion, there_stages
from rmpa.ros.wire.tcpros import TopicDescription

_MD5 = "992ce8a1687cec8c8bd883ec73ca41d1"
SEEDS: list[bytes] = [
    b"",
    TopicHeader(
        TopicDescription("std_msgs/String", _MD5, "string data\n", True), "/n", 7, 5, 1, 2, 3, 2**60
    ).serialize(),
    msgspec.json.encode(WhyQuestion(site="hall", name="/scan", module="arm")),
    msgspec.json.encode(
        WhyAnswer(
            sources=(SourceThere(kind="t", module="arm", node="/n", wanted=True, messages=3),), modules=("arm",)
        )
    ),
]


def fuzz(data: bytes) -> None:
    """Each document is read as it will be written again, or refused."""
    try:
        read = TopicHeader.parse(data)
        if TopicHeader.parse(read.serialize()) != read:
            raise AssertionError(f"{read} does not survive its text")
    except RemoteProtocolError as error:
        _check_text(error)
    for question in (WhyQuestion, WhyAnswer):
        try:
            told = question.parse(data)
        except RemoteProtocolError as error:
            _check_text(error)
            continue
        if question.parse(msgspec.json.encode(told)) != told:
            raise AssertionError(f"{told} does not survive its text")
        for source in told.sources if isinstance(told, WhyAnswer) else ():
            there_stages("hall", "arm", "/scan", source, "")


def _check_text(error: RemoteProtocolError) -> None:
    if not str(error).isprintable():
        raise AssertionError(f"an error's text is not safe to log: {str(error)!r}")
