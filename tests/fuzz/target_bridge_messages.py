"""Control messages between bridges."""

from __future__ import annotations

from rmpa.bridge.messages import decode, encode
from rmpa.core.errors import RemoteProtocolError

SEEDS: list[bytes] = [
    b'{"op":"advertise","added":[{"topic":"/cmd","node":"/joy","type":"sensor_msgs/Joy"}],"removed":[],"full":true}',
    b'{"op":"open","route":7,"topic":"/cmd","node":"/joy"}',
    b'{"op":"opened","route":7,"description":{"type":"a/B","md5":"5a9ea5f83505693b71e785041e67a8bb","definition":"x","latching":true}}',
    (
        b'{"op":"open","route":4294967295,"topic":"/cmd","node":"/joy","epoch":3,"after":4294967295,"contract":'
        b'{"reliability":"reliable","durability":"transient_local","history":"keep_all","depth":10,"deadline":0.2,'
        b'"lifespan":null,"liveliness":"manual_by_topic","liveliness_lease":2.0,"priority":"high","max_rate":50.0}}'
    ),
    (
        b'{"op":"opened","route":7,"epoch":1,"first":1,"contract":{"priority":"low"},"description":'
        b'{"type":"a/B","md5":"5a9ea5f83505693b71e785041e67a8bb","definition":"","latching":false}}'
    ),
    b'{"op":"closed","route":7,"reason":"the node has gone"}',
    b'{"op":"mismatch","topic":"/cmd","node":"/joy","subscriber":"/base","text":"md5"}',
    b'{"op":"audience","route":7,"nodes":["/arm","/move_base"]}',
]


def fuzz(data: bytes) -> None:
    """Decode; what decodes must survive the way back."""
    try:
        message = decode(data)
    except RemoteProtocolError:
        return
    assert decode(encode(message)) == message
