"""What gateways read from sites and from ROS 2: rows as those of ``readers``."""

from __future__ import annotations

from typing import Any, Final

import msgspec

from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway.ros2 import format as ros2_tokens
from rmpa.gateway.ros2.format import Ros2Attachment, Ros2Endpoint
from rmpa.gateway.ros2.graph import Ros2Graph
from rmpa.gateway.sites import keys as site_keys
from rmpa.gateway.sites.answers import WhyQuestion, parse_ways
from rmpa.gateway.sites.keys import AttachmentReader, MessageSource, TopicHeader
from rmpa.gateway.sites.services import asked_type, read_description
from rmpa.observe.check import OK, Check
from rmpa.observe.why.diagnosis import Diagnosis
from rmpa.ros.wire.tcpros import ServiceDescription
from rmpa.ros.wire.xmlrpc import serialize_response
from tests.fuzz.readers import MD5, Reader, Row, printable, text

_RUN: Final = "0123456789abcdef0123456789abcdef"
_ENDPOINT: Final = (
    "@ros2_lv/0/aac3178e146ba6f1fc6e6a4085e77f21/0/{}/{}/%/%ns/talker/%chatter/{}/RIHS01_"
    + "0" * 64
    + "/::,10:,:,:,,"
)
_TEXT: Final = serialize_response({"p": 1.5, "names": ["a", True], "blob": b"\0\1"}).decode()


def _check_site_token(read: Any) -> None:
    assert read is None or site_keys.parse_token(read.token()) == read, f"{read} does not survive its token"


def _check_ros2_token(read: Any) -> None:
    assert read is None or ros2_tokens.parse_token(read.token()) == read, f"{read} does not survive its token"
    assert not isinstance(read, Ros2Endpoint) or read.key(), "an endpoint has no key"


def _graph(key: str) -> None:
    graph = Ros2Graph(0, "own")
    shown = graph.change(key, alive=True)
    gone = graph.change(key, alive=False)
    assert gone == shown, "a token is gone otherwise than it came"
    assert (len(graph), len(graph.nodes)) == (0, 0), "a token that is gone stays in the graph"


def _safe_stages(ways: tuple[Diagnosis, ...]) -> None:
    for stage in (stage for way in ways for stage in way.stages):
        printable(f"{stage.name}{stage.text}{stage.remedy}")


def _row(readers: list[Reader], *seeds: bytes, error: type[Exception] = RemoteProtocolError) -> Row:
    return Row(readers, [b"", *seeds], plain=True, errors=(error,))


GATEWAY_READERS: Final[dict[str, Row]] = {
    "gateway_attachments": _row(
        [
            Reader(Ros2Attachment.parse, Ros2Attachment.serialize),
            Reader(lambda data: AttachmentReader().read(data), lambda read: read[2].writer()(read[0], read[1])),
            Reader(read_description),
        ],
        Ros2Attachment(1, 2**40, bytes(range(16))).serialize(),
        Ros2Attachment(-1, 0, bytes(24)).serialize() + b"later",
        MessageSource(MD5, "/talker", ("warehouse",), latched=True).writer()(1, 2**40),
        MessageSource(MD5, "/ns/node", ("a", "b", "c")).writer()(2**63, 0),
        MessageSource(MD5, "/talker", ("yard",), run=7).writer()(5, 0),
        msgspec.json.encode(ServiceDescription("std_srvs/Trigger", MD5)),
        b"{}",
    ),
    "gateway_keys": _row(
        [
            Reader(text(site_keys.parse_token), check=_check_site_token),
            Reader(text(ros2_tokens.parse_token), check=_check_ros2_token),
            Reader(text(asked_type)),
            Reader(text(_graph)),
        ],
        f"rmpa/1/warehouse/arm/up/{_RUN}".encode(),
        f"rmpa/1/warehouse/arm/up/{_RUN}/t/sensor_msgs%LaserScan/%lidar%driver/%base%scan".encode(),
        f"rmpa/1/warehouse/arm/up/{_RUN}/s/-/%node/%stop".encode(),
        f"rmpa/1/warehouse/arm/to/{_RUN}/yard/t/sensor_msgs%LaserScan/%lidar%driver/%base%scan".encode(),
        b"rmpa/1/warehouse/arm/to/yard/s/std_srvs%Trigger/stop",
        f"rmpa/1/warehouse/-gateway/010/{_RUN}".encode(),
        b"rmpa/1/warehouse/arm/s/std_srvs%Trigger/stop",
        _ENDPOINT.format(1, "MP", "std_msgs::msg::dds_::String_").encode(),
        _ENDPOINT.format(2, "SS", "std_srvs::srv::dds_::Trigger_").replace("::,10:", "2:1:2,1:3,4:").encode(),
        b"@ros2_lv/3/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/talker",
    ),
    "site_documents": _row(
        [
            Reader(TopicHeader.parse, msgspec.json.encode),
            Reader(WhyQuestion.parse, msgspec.json.encode),
            Reader(parse_ways, msgspec.json.encode, _safe_stages),
        ],
        msgspec.json.encode(TopicHeader("std_msgs/String", MD5, "string data\n", True, "/n", 7, 5, 1)),
        msgspec.json.encode(WhyQuestion(site="hall", name="/scan", module="arm")),
        msgspec.json.encode(
            [Diagnosis.of((Check("sent", OK, "3 messages"),), name="/scan", peer="arm", to="site hall", node="/n")]
        ),
    ),
}
