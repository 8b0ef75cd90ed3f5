"""What is read from bytes of others: a value that survives its round trip, or the documented error, safe to log.

A row of ``READERS`` is a target: its functions, each with what writes a value again, and its seeds.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from ipaddress import IPv4Address
from typing import Any, Final, NamedTuple

import msgspec

from rmpa.bridge.direct.paths import DirectAsk, Grant, read_ask, read_reply, reply_of
from rmpa.bridge.messages import decode, encode
from rmpa.core.contract import Contract
from rmpa.core.errors import RmpaError
from rmpa.core.identity import Guid, Identity
from rmpa.core.outbox import ABORT, FIRST, LAST
from rmpa.discovery.beacon import Beacon, BeaconKind
from rmpa.mesh.frames import Frame, FrameKind, Hello, Refuse, judge, judge_welcome, parse_pong, parse_text, pong
from rmpa.observe.control_client import ControlReply, ControlRequest
from rmpa.observe.snapshot import Snapshot
from rmpa.ros import limits
from rmpa.ros.core.state import parse as parse_core_state
from rmpa.ros.core.state import serialize as serialize_core_state
from rmpa.ros.master.api import MasterApi
from rmpa.ros.types.definitions import SEPARATOR, full_text, md5sum, parse_definition
from rmpa.ros.types.installed import ServiceType
from rmpa.ros.types.messages import MessageError, MessageType
from rmpa.ros.wire import tcpros, xmlrpc
from rmpa.ros.wire.log import parse_log, renamed
from rmpa.ros.wire.slave_api import read_bus_info
from rmpa.ros.wire.tcpros import ServiceDescription, TopicDescription
from rmpa.runtime.kernel_tcp import TcpSocket, destroy_query, read_answer
from rmpa.trust.packets import GroupKey, KeyRing, PacketTrust, Verdict
from rmpa.trust.tokens import (
    CertificateGrant,
    Join,
    JoinRefused,
    Renew,
    Token,
    decode_message,
    encode_message,
)
from tests.mesh.worlds import with_peer
from tests.ros.documents import parse_call, serialize_call

_BASE: Final = Identity(Guid.of("10.0.0.1", 40001, 7), bytes(range(16)), "base")
_OURS: Final = Identity(Guid.of("10.0.0.2", 40002, 1), b"O" * 16, "ours")
MD5: Final = "992ce8a1687cec8c8bd883ec73ca41d1"
_STRING: Final = TopicDescription("std_msgs/String", MD5, "string data\n", latching=True)
_ADD: Final = ServiceDescription("rospy_tutorials/AddTwoInts", "6a2e34150c00229791cc89ff309fff21")
_TOKEN: Final = Token(1_790_000_000, IPv4Address("10.0.0.1"), 40001, bytes(range(16)), bytes(range(16))).serialize()
_INFO: Final = "TCPROS connection on port 34738 to [127.0.0.1:52309 on socket 13]"
_HEADER: Final = struct.Struct("=IHHII")
_BODY: Final = bytes([2, 1, 0, 0]) + bytes(range(48)) + bytes(20)
_STATE: Final = {
    "format": "rmpa core 2",
    "nodes": {
        "/n": {"api": "http://h:1/", "entries": [["publisher", "/t", "a/B"], ["service", "/s", "rosrpc://h:2"]]}
    },
    "params": {"a": {"b": [1, "x", 2.5], "c": {}}, "e": b"\0", "d": msgspec.msgpack.Ext(1, b"2020-01-01T00:00:00")},
}


def _answer(kind: int, flags: int, body: bytes) -> bytes:
    return _HEADER.pack(_HEADER.size + len(body), kind, flags, 0, 0) + body


class Reader(NamedTuple):
    """A function that reads.

    Args:
        read: It; another error than the row's is found.
        write: The way back; what is read of that must be the same value.
        check: Raises ``AssertionError`` if a value that was read must not be.
    """

    read: Callable[[bytes], Any]
    write: Callable[[Any], bytes] | None = None
    check: Callable[[Any], object] = lambda _: None


@dataclass(frozen=True, slots=True)
class Row:
    """Readers of the same seeds; ``plain``: their errors repeat no bytes, which the log would have to escape."""

    readers: Sequence[Reader]
    seeds: Sequence[bytes]
    plain: bool = False
    errors: tuple[type[Exception], ...] = (RmpaError, ValueError, OSError)

    def fuzz(self, data: bytes) -> None:
        """Let each read."""
        for reader in self.readers:
            try:
                value = reader.read(data)
            except self.errors as error:
                said = str(error)
            else:
                reader.check(value)
                said = ""
                if reader.write is not None:
                    assert reader.read(reader.write(value)) == value, f"{value} does not survive its round trip"
            assert not self.plain or said.isprintable(), f"an error's text is not safe to log: {said!r}"


def text(read: Callable[[str], Any]) -> Callable[[bytes], Any]:
    return lambda data: read(data.decode("utf-8", "replace"))


def _json(read: Callable[[Any], Any]) -> Callable[[bytes], Any]:
    """As messages between agents are decoded; no reader is told what is no JSON."""

    def read_json(data: bytes) -> Any:
        try:
            value = msgspec.json.decode(data)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            raise ValueError("no JSON") from None
        return read(value)

    return read_json


def printable(value: object) -> None:
    assert str(value).isprintable(), "a value's text is not safe to log"


def _ask(value: Any) -> DirectAsk:
    if not isinstance(value, dict):
        raise ValueError("no arguments")  # noqa: TRY004 - as what is malformed otherwise
    return read_ask(value)


def _check_reply(found: Any) -> None:
    if isinstance(found, Grant):
        assert 0 < found.port < 1 << 16
        printable(found.probe)
    else:
        printable(found.text)
    assert read_reply(reply_of(found), "/talker") == found


def _frame(data: bytes) -> tuple[Frame, int] | None:
    parsed = Frame.parse(data)
    if parsed is not None and parsed[0].kind is FrameKind.PONG:
        parse_pong(parsed[0].payload)
    return parsed


def _check_frame(found: tuple[Frame, int] | None) -> None:
    if found is not None:
        printable(found[0])
        printable(parse_text(found[0].payload))


def _hello(data: bytes) -> Hello:
    found = Hello.parse(data)
    if isinstance(found, Refuse):
        raise ValueError(found.text)  # noqa: TRY004 - it was refused
    return found


def _check_hello(hello: Hello) -> None:
    verdict = judge(hello, _OURS, with_peer(_BASE, dialled=False))
    judge_welcome(hello, _OURS, _BASE.guid)
    assert verdict is not None or hello.identity.guid == hello.guid, "a welcome peer has no identity"
    assert hello.lease > 0
    printable(hello.name)


def _check_reply_value(reply: ControlReply) -> None:
    try:
        msgspec.convert(reply.value, Snapshot)
    except msgspec.ValidationError as error:
        str(error)


def _bus(data: bytes) -> Any:
    try:
        answer = xmlrpc.parse_response(data)
    except (RmpaError, xmlrpc.RosFault):
        answer = [[1, "/n", "o", "TCPROS", "/t", True, data.decode("latin-1")]]
    return read_bus_info(answer)


def _check_bus(found: Any) -> None:
    ports = [port for link in found for port in (link.local_port, link.remote[1] if link.remote else None)]
    assert all(port is None or 0 < port <= 65535 for port in ports)


def _sockets(data: bytes) -> list[bytes]:
    found: list[bytes] = []
    read_answer(data, found, 0)
    return found


def _check_sockets(found: list[bytes]) -> None:
    for body in found:
        assert destroy_query(TcpSocket.parse(body))[8:] == body[4:52], "a part of a socket was taken for the whole"


def _definition(data: bytes) -> None:
    known = parse_definition("p/T", data.decode(errors="surrogateescape"))
    assert md5sum("p/T", parse_definition("p/T", full_text("p/T", known))) == md5sum("p/T", known)


def _header(data: bytes) -> Any:
    fields, consumed, wanted = tcpros.parse_header(data)
    if fields is None:
        assert not consumed
        assert wanted > len(data), "a header that is not whole wants more than there is"
    else:
        for end in (0, 3, consumed - 1):
            assert tcpros.parse_header(data[:end])[0] is None, "a part of a header was taken for the whole"
    return fields


def _check_header(fields: Any) -> None:
    if fields is None:
        return
    tcpros.is_set(fields, "persistent")
    for problem in (
        tcpros.check_subscriber(fields, "/t", "/p", _STRING),
        tcpros.check_publisher(fields, "a/B", "0" * 32),
        tcpros.check_client({"md5sum": "", "callerid": "", **fields}, "/add", "/s", _ADD),
        tcpros.check_server(fields, "/add", _ADD.md5sum),
        ServiceDescription.from_header(fields),
    ):
        printable(problem)


def _split(data: bytes) -> list[bytes]:
    """Every whole message once and in order, however the bytes are cut."""
    messages, consumed, wanted = tcpros.split_messages(memoryview(data))
    assert b"".join(messages) == data[:consumed]
    assert wanted <= limits.TCPROS_MESSAGE_MAX + 4
    first, start, _ = tcpros.split_messages(memoryview(data[: len(data) // 2]))
    rest = tcpros.split_messages(memoryview(data[start:]))[0] if start < len(data) else []
    found = [bytes(message) for message in messages]
    assert [bytes(message) for message in (*first, *rest)] == found, "a cut changes the messages"
    return found


def _check_messages(found: list[bytes]) -> None:
    for message in found[:4]:
        for kind in (_JOY, _LEARNT):
            try:
                kind.to_plain(kind.deserialize(message[4:]))
            except MessageError as error:
                str(error)


def _reply_body(data: bytes) -> None:
    head = tcpros.parse_reply_head(data)
    if head is None:
        return
    ok, size = head
    assert size <= limits.SERVICE_MESSAGE_MAX, "more was believed than is allowed"
    body = tcpros.BodyBuffer(size)
    taken = body.take(memoryview(data)[5:])
    assert taken == min(size, len(data) - 5)
    assert body.whole == (taken == size)
    assert not body.whole or tcpros.REPLY.pack(ok, size) + body.data == bytes([ok]) + data[1 : 5 + size]


def _address(text: str) -> None:
    host, port = tcpros.parse_service_uri(text)
    assert host
    assert port >= 0


def _service_type(text: str) -> None:
    assert len(ServiceType("p/T", text).md5sum) == 32


def _core_state(data: bytes) -> bytes:
    """What the file of a core holds can be kept again, shown, and said in XML-RPC."""
    state = parse_core_state(data)
    master = MasterApi("http://h:1/", 1, lambda _: None)
    master.parameters.set("/", state.params)
    for name, node in state.nodes.items():
        for kind, key, detail in node.entries:
            master.registrations.register(kind, key, name, node.api, detail)
    for method, *arguments in (("getSystemState",), ("getParam", "/"), ("getTopicTypes",)):
        for _ in xmlrpc.response_pieces(list(master.call(method, ["/x", *arguments]))):
            pass
    return serialize_core_state(state)


def _trailer(data: bytes) -> None:
    """Nothing is accepted but the one packet that a member signed."""
    verdict = PacketTrust(_RING, lambda: 1_790_000_001.0).verify(data, (16, 32), 1.0).verdict
    assert (verdict is Verdict.ACCEPTED) is (data == _SIGNED), verdict


def _frames(*frames: Frame) -> list[bytes]:
    return [frame.serialize() for frame in frames]


_RING: Final = KeyRing([GroupKey(3, bytes(range(32)))], 0.0)
_SIGNED: Final = PacketTrust(_RING, lambda: 1_790_000_000.0).sign(bytes(range(60)), 1.0)
_JOY: Final = MessageType("sensor_msgs/Joy")
_LEARNT: Final = MessageType.learn(
    "my_msgs/All",
    f"time[] t\nstring[] s\nbool[3] b\nHeader h\n{SEPARATOR}\nMSG: std_msgs/Header\n"
    "uint32 seq\ntime stamp\nstring frame_id\n",
)
_PEER: Final = Guid.of("10.0.0.2", 40002)

# The targets by name.
READERS: Final[dict[str, Row]] = {
    "beacon": Row(
        [Reader(lambda data: Beacon.parse(data, 0), Beacon.serialize, printable)],
        [
            b"RMPA",
            Beacon(BeaconKind.ANSWER, _BASE, 16000, 2, (_PEER, Guid.of("10.0.0.3", 1))).serialize(),
            Beacon(BeaconKind.HEARTBEAT, _BASE, 16000, 3, (_PEER,), (("192.168.0.9", 40002),)).serialize(),
            Beacon(BeaconKind.GOODBYE, _BASE, 0, 0xFFFFFFFF).serialize() + b"later versions",
        ],
    ),
    "bridge_messages": Row(
        [Reader(decode, encode)],
        [
            (
                b'{"op":"advertise","added":[{"topic":"/cmd","node":"/rmpa/pad/joy","type":"sensor_msgs/Joy","origin":'
                b'{"name":"pad","guid":"10.0.0.1:4000#7","instance":"00000000000000000000000000000001","node":"/joy",'
                b'"path":["ffffffffffffffffffffffffffffffff"]}}],"removed":[],"full":true}'
            ),
            (
                b'{"op":"open","route":4294967295,"topic":"/cmd","node":"/joy","epoch":3,"after":4294967295,"contract":'
                b'{"reliability":"reliable","durability":"transient_local","history":"keep_all","depth":10,"deadline":0.2,'
                b'"lifespan":null,"liveliness":"manual_by_topic","liveliness_lease":2.0,"priority":"high","max_rate":5.0}}'
            ),
            (
                b'{"op":"opened","route":7,"epoch":1,"first":1,"contract":{"priority":"low","transport":"auto"},'
                b'"description":{"type":"a/B","md5":"5a9ea5f83505693b71e785041e67a8bb","definition":"","latching":false}}'
            ),
            b'{"op":"closed","route":7,"reason":"the node has gone"}',
            b'{"op":"mismatch","topic":"/cmd","node":"/joy","subscriber":"/base","text":"md5"}',
            b'{"op":"audience","route":7,"nodes":["/arm","/move_base"]}',
            b'{"op":"services","added":[{"service":"/add","node":"/adder"}],"removed":["/sub"],"full":true,"more":true}',
            b'{"op":"service_open","route":2147483649,"service":"/add","timeout":2.5}',
            (
                b'{"op":"service_opened","route":2147483649,"requests":2147483650,"type":"a/Add",'
                b'"md5":"6a2e34150c00229791cc89ff309fff21","request_type":"a/AddRequest","response_type":"a/AddResponse"}'
            ),
            b'{"op":"service_closed","route":2147483649,"reason":"its server has gone"}',
            b'{"op":"ask","number":3,"what":"param.get","args":{"key":"/a"}}',
            b'{"op":"answer","number":3,"ok":false,"value":null,"error":"no /a","remedy":"set it"}',
        ],
    ),
    "bus": Row(
        [Reader(_bus, check=_check_bus)],
        [
            xmlrpc.serialize_response(
                [1, "", [[1, "http://127.0.0.1:3617/", "i", "TCPROS", "/chatter", True, _INFO]]]
            ),
            f"Closed {_INFO}".encode(),
        ],
    ),
    "control": Row(
        [
            Reader(ControlRequest.parse, ControlRequest.serialize, printable),
            Reader(ControlReply.parse, ControlReply.serialize, _check_reply_value),
        ],
        [
            b'{"op": "ping", "args": {"peer": "base", "count": 1}}\n',
            b'{"op": "x", "args": {"deep": [[[[[[]]]]]], "big": 1e308, "text": "\\u0000\\ud83d\\ude00"}}',
            b'{"ok": false, "error": "no peer", "remedy": "did you mean base?"}\n',
            (
                b'{"ok": true, "value": {"agent": {"name": "a", "guid": "", "instance": "", "domain": 0, '
                b'"core_uri": "", "version": "", "pid": 1, "started": 0, "uptime": 0}, "taken": 0, "peers": []}}\n'
            ),
        ],
    ),
    "core_state": Row(
        [Reader(_core_state, lambda kept: kept)],
        [msgspec.msgpack.encode(_STATE), msgspec.msgpack.encode({"format": "rmpa core 2", "boot": "4f0c"})],
    ),
    "direct": Row(
        [
            Reader(_json(_ask), msgspec.json.encode),
            Reader(_json(lambda value: read_reply(value, "/talker")), check=_check_reply),
        ],
        [
            msgspec.json.encode(DirectAsk("/chatter", "/talker", "/viewer", Contract(), True)),
            b'{"name": "/chatter", "node": "/talker", "user": "/viewer"}',
            b'{"port": 70000, "probe": "/adder/get_loggers"}',
            b'{"why": "caller_id", "text": "another /viewer"}',
            b'{"why": "moon", "text": "of a later release"}',
        ],
        plain=True,
    ),
    "frames": Row(
        [Reader(_frame, lambda parsed: parsed[0].serialize() if parsed else b"", _check_frame)],
        [
            b"",
            *_frames(
                Frame(FrameKind.PING, stamp_ns=1),
                pong(1, 2, 3),
                Frame(FrameKind.CONTROL, b'{"op":"x"}'),
                Frame(FrameKind.BYE, b"ends"),
                Frame(FrameKind.DATA, b"\x08\0\0\0abcd", 7, 1, 99, FIRST),
                Frame(FrameKind.DATA, b"efgh", 7, 1, 99, LAST),
                Frame(FrameKind.DATA, b"", 7, 1, 99, LAST | ABORT),
                *(Frame(kind, route=7, sequence=0xFFFFFFFF) for kind in (FrameKind.ACK, FrameKind.FENCED)),
            ),
        ],
    ),
    "handshake": Row(
        [Reader(Refuse.parse), Reader(_hello, Hello.serialize, _check_hello)],
        [
            b"RMPA\x03\x01\x00\x00",
            Hello.of(_BASE, lease=1.0, expected=_OURS.guid).serialize(),
            Hello.of(_BASE, lease=1.0, expected=None).serialize() + b"later versions",
            Hello.of(_OURS, lease=60.0, expected=None, lane=2).serialize(),
            Refuse(2, "another domain").serialize(),
        ],
    ),
    "join": Row(
        [Reader(decode_message, lambda message: encode_message(message)[4:])],
        [
            b'{"op":"renew","x":' + b"[" * 2000,
            *(
                encode_message(each)[4:]
                for each in (
                    Join(b"token", b"request", b"proof"),
                    Renew(b"request"),
                    CertificateGrant(b"certificate", b"ca", b"keys", b"deny"),
                    JoinRefused("revoked", "it was revoked"),
                )
            ),
        ],
    ),
    "kernel_tcp": Row(
        [Reader(_sockets, check=_check_sockets)],
        [
            _answer(20, 2, _BODY + struct.pack("=HH", 4 + 136, 2) + bytes(120) + struct.pack("=QQ", 1 << 40, 7)),
            _answer(20, 2, _BODY) * 2 + _answer(3, 2, bytes(4)),
            _answer(2, 0, struct.pack("=i", -1) + bytes(16)),
            _answer(2, 0, struct.pack("=i", -(1 << 31)) + bytes(16)),
            _answer(20, 0x12, bytes(72)),
            _answer(1, 0, b"") + _answer(3, 2, b""),
        ],
        plain=True,
    ),
    "message_definitions": Row(
        [Reader(_definition)],
        [
            b"int32 A=1\nstring S= x # y\nuint8[] data # note\nfloat64[36] c\n",
            *(MessageType(name).definition.encode() for name in ("sensor_msgs/Joy", "nav_msgs/Odometry")),
            b"T t\n" + b"=" * 80 + b"\nMSG: p/T\nint32 a\n",
        ],
    ),
    "services": Row(
        [
            Reader(_reply_body),
            Reader(text(_address)),
            Reader(text(_service_type)),
        ],
        [
            tcpros.REPLY.pack(True, 3) + b"abc",
            tcpros.REPLY.pack(False, 2) + b"no",
            b"\x01\xff\xff\xff\xff",
            b"rosrpc://127.0.0.1:1234",
            b"int64 a\nint64 b\n---\nint64 sum",
            b"std_msgs/Header h\nstring X=a#b\n---\n",
        ],
    ),
    "log": Row(
        [
            Reader(lambda data: parse_log(data, 8), check=lambda said: said.text.decode("utf-8", "replace")),
            Reader(lambda data: parse_log(renamed(data, "/rmpa/arm/driver"), 8)),
        ],
        [b"", bytes(30), bytes((37, *bytes(11), 2, *bytes(3))) + b"ab\x08\x02\0\0\0/n\x04\0\0\0text" + bytes(16)],
    ),
    "tcpros_header": Row(
        [Reader(_header, lambda fields: tcpros.encode_header(fields) if fields is not None else b"", _check_header)],
        [
            b"",
            bytes(4),
            tcpros.encode_header(tcpros.subscriber_header("/t", "/s", tcpros.TopicDescription("a/B", "0" * 32, ""))),
            tcpros.encode_header(tcpros.publisher_header("/t", "/p", _STRING)) + b"\x05\x00\x00\x00hello",
            tcpros.encode_header({"error": "no \udcff"}),
            tcpros.encode_header(tcpros.client_header("/add", "/c", persistent=True, probe=True)),
            tcpros.encode_header(tcpros.server_header("/s", _ADD)),
        ],
        plain=True,
    ),
    "tcpros_messages": Row(
        [Reader(_split, check=_check_messages)],
        [
            tcpros.frame_message(b"abc") + tcpros.frame_message(b"") + b"\x05\x00\x00\x00he",
            tcpros.frame_message(_JOY.serialize(_JOY.make({"axes": [1.0], "buttons": [1, 2]}))),
            tcpros.frame_message(_LEARNT.serialize(_LEARNT.make({"t": [1.5], "s": ["a"], "h": {"frame_id": "x"}}))),
            b"\xff\xff\xff\xff",
        ],
    ),
    "token": Row(
        [Reader(text(Token.parse), lambda token: token.serialize().encode())],
        [b"rmpa1-", b"rmpa2-" + b"a" * 85, _TOKEN.encode(), _TOKEN.upper().encode() + b"\r\n"],
    ),
    "trailer": Row([Reader(_trailer)], [bytes(31), bytes(64), _SIGNED, _SIGNED[:-1], _SIGNED + b"x", _SIGNED[32:]]),
    "xmlrpc": Row(
        [Reader(parse_call), Reader(xmlrpc.parse_response)],
        [
            serialize_call("setParam", ("/n", "/p", {"a": [1, 2.5, True, "x", b"y"], "b": {}})),
            xmlrpc.serialize_response([1, "ok", [["/rosout", ["/talker"]]]]),
            xmlrpc.serialize_fault(1, "no such method"),
            b"<methodCall><methodName>m</methodName><params><param><value>untyped</value></param></params></methodCall>",
            b'<!DOCTYPE x [<!ENTITY a "aaaa">]><methodCall><methodName>&a;</methodName></methodCall>',
        ],
    ),
}
