"""Fuzz target: headers of publishers of other sites, and ``rmpa why`` of gateways."""

from __future__ import annotations

import msgspec

from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway.sites.answers import WhyQuestion, parse_ways
from rmpa.gateway.sites.keys import TopicHeader
from rmpa.observe.peer_info import OK, Check
from rmpa.observe.why.diagnosis import Diagnosis

_MD5 = "992ce8a1687cec8c8bd883ec73ca41d1"
SEEDS: list[bytes] = [
    b"",
    b"[" * 100_000,
    b'{"a":' * 900 + b"1" + b"}" * 900,
    b"9" * 100_000,
    b'"\\ud800"',
    b"\xff\xfe",
    msgspec.json.encode(TopicHeader("std_msgs/String", _MD5, "string data\n", True, "/n", 7, 5, 1)),
    msgspec.json.encode(WhyQuestion(site="hall", name="/scan", module="arm")),
    msgspec.json.encode(
        [Diagnosis.of((Check("sent", OK, "3 messages"),), name="/scan", peer="arm", to="site hall", node="/n")]
    ),
]


def fuzz(data: bytes) -> None:
    """Each document is read as it will be written again, or refused."""
    try:
        read = TopicHeader.parse(data)
        if TopicHeader.parse(msgspec.json.encode(read)) != read:
            raise AssertionError(f"{read} does not survive its text")
    except RemoteProtocolError as error:
        _check_text(error)
    for parse in (WhyQuestion.parse, parse_ways):
        try:
            told = parse(data)
        except RemoteProtocolError as error:
            _check_text(error)
            continue
        if parse(msgspec.json.encode(told)) != told:
            raise AssertionError(f"{told} does not survive its text")
        for stage in (stage for way in told for stage in way.stages) if isinstance(told, tuple) else ():
            if not f"{stage.name}{stage.text}{stage.remedy}".isprintable():
                raise AssertionError(f"a stage is not safe to show: {stage}")


def _check_text(error: RemoteProtocolError) -> None:
    if not str(error).isprintable():
        raise AssertionError(f"an error's text is not safe to log: {str(error)!r}")
