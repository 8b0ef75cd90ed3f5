"""Fuzz target: headers of publishers and last values of other sites, ``rmpa why`` of gateways, patterns of keys."""

from __future__ import annotations

import msgspec

from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway.sites.last_values import ValueHeader, fits, parse_value_key, value_key
from rmpa.gateway.sites.topic_header import TopicHeader
from rmpa.gateway.sites.why import SourceThere, WhyAnswer, WhyQuestion, there_stages
from rmpa.ros.wire.tcpros import TopicDescription

_MD5 = "992ce8a1687cec8c8bd883ec73ca41d1"
SEEDS: list[bytes] = [
    b"",
    TopicHeader(
        TopicDescription("std_msgs/String", _MD5, "string data\n", True), "/n", 7, 5, 1, 2, 3, 2**60
    ).serialize(),
    ValueHeader(node="/n", type="std_msgs/String", md5sum=_MD5, definition="x", stamp=2**60, size=9).serialize(),
    msgspec.json.encode(WhyQuestion(site="hall", name="/scan", module="arm")),
    msgspec.json.encode(
        WhyAnswer(
            sources=(SourceThere(kind="t", module="arm", node="/n", wanted=True, messages=3),), modules=("arm",)
        )
    ),
    value_key("hall", "arm", "/base/map").encode(),
    b"rmpa/1/hall/*/v/**",
    b"rmpa/1/*/arm/v/base/**/map",
]


def fuzz(data: bytes) -> None:
    """Each document is read as it will be written again, or refused; a pattern fits a key or not, in a short time."""
    for kind in (TopicHeader, ValueHeader):
        try:
            read = kind.parse(data)
        except RemoteProtocolError as error:
            _check_text(error)
            continue
        if kind.parse(read.serialize()) != read:
            raise AssertionError(f"{read} does not survive its text")
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
    _fuzz_key(data.decode("utf-8", "replace"))


def _fuzz_key(key: str) -> None:
    fits(key, value_key("hall", "arm", "/base/map"))
    try:
        site, module, topic = parse_value_key(key)
    except RemoteProtocolError as error:
        _check_text(error)
        return
    if "*" not in key and not fits(key, key):
        raise AssertionError(f"{key!r} does not fit itself")
    if topic.strip("/") == topic[1:] and parse_value_key(value_key(site, module, topic)) != (site, module, topic):
        raise AssertionError(f"{key!r} names another value once it is written")


def _check_text(error: RemoteProtocolError) -> None:
    if not str(error).isprintable():
        raise AssertionError(f"an error's text is not safe to log: {str(error)!r}")
