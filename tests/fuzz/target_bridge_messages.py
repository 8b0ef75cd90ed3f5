"""Control messages between bridges."""

from __future__ import annotations

from rmpa.bridge.messages import decode, encode
from rmpa.core.errors import RemoteProtocolError

SEEDS: list[bytes] = [
    b'{"op":"advertise","added":[{"topic":"/cmd","node":"/joy","type":"sensor_msgs/Joy"}],"removed":[],"full":true}',
    (
        b'{"op":"advertise","added":[{"topic":"/cmd","node":"/rmpa/pad/joy","type":"sensor_msgs/Joy","origin":'
        b'{"name":"pad","guid":"10.0.0.1:4000#7","instance":"00000000000000000000000000000001","node":"/joy",'
        b'"path":["ffffffffffffffffffffffffffffffff"]}}]}'
    ),
    b'{"op":"open","route":7,"topic":"/cmd","node":"/joy"}',
    b'{"op":"opened","route":7,"description":{"type":"a/B","md5":"5a9ea5f83505693b71e785041e67a8bb","definition":"x","latching":true}}',
    (
        b'{"op":"open","route":4294967295,"topic":"/cmd","node":"/joy","epoch":3,"after":4294967295,"contract":'
        b'{"reliability":"reliable","durability":"transient_local","history":"keep_all","depth":10,"deadline":0.2,'
        b'"lifespan":null,"liveliness":"manual_by_topic","liveliness_lease":2.0,"priority":"high","max_rate":50.0}}'
    ),
    (
        b'{"op":"opened","route":7,"epoch":1,"first":1,"contract":{"priority":"low","transport":"auto"},"description":'
        b'{"type":"a/B","md5":"5a9ea5f83505693b71e785041e67a8bb","definition":"","latching":false}}'
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
    b'{"op":"service_close","route":2147483649}',
    b'{"op":"service_closed","route":2147483649,"reason":"its server has gone"}',
    b'{"op":"ask","number":3,"what":"param.get","args":{"key":"/a"}}',
    b'{"op":"answer","number":3,"ok":false,"value":null,"error":"no /a","remedy":"set it"}',
    b'{"op":"tell","what":"param.changed","args":{"key":"/a"}}',
]


def fuzz(data: bytes) -> None:
    """Decode; what decodes must survive the way back."""
    try:
        message = decode(data)
    except RemoteProtocolError:
        return
    assert decode(encode(message)) == message
