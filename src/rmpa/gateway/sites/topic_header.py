r"""The answer of a gateway to the question for a publisher's header (``…/d/t/<topic>``): JSON.

::

    {"type": "std_msgs/String", "md5sum": "992ce8a1687cec8c8bd883ec73ca41d1", "latching": false,
     "definition": "string data\n", "node": "/talker", "run": 17, "sequence": 42, "waiting": 0}

The question's parameters are ``node`` (one publisher of several; without it any) and ``site`` (the site that asks).
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.identity import is_type_name
from rmpa.gateway import limits
from rmpa.ros.wire.tcpros import TopicDescription

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.ros.wire.tcpros import Buffer

REFUSED: Final = "refused: "
"""What an error begins with that a rule causes: asking again is of no use."""
_HEX: Final = frozenset("0123456789abcdef")
_COUNT_MAX: Final = 2**63 - 1


@dataclass(frozen=True, slots=True)
class TopicHeader:
    """What a gateway says of one publisher of its site.

    Args:
        description: The publisher's own header.
        node: The publisher, in its module.
        run: The run of its exporter, by which sequence numbers are told apart.
        sequence: The number of the last message that was taken for the other sites.
        waiting: Messages that wait there for a slow link.
    """

    description: TopicDescription
    node: str
    run: int = 0
    sequence: int = 0
    waiting: int = 0

    def serialize(self) -> bytes:
        """The JSON of it."""
        fields = asdict(self)
        return json.dumps({**fields.pop("description"), **fields}).encode()

    @classmethod
    def parse(cls, data: Buffer) -> TopicHeader:
        """Read an answer; unknown keys are ignored.

        Raises:
            RemoteProtocolError: It is too long, no JSON object, or type, md5 sum or a number is none.
        """
        if len(data) > limits.HEADER_MAX:
            raise LimitExceeded("the header of a publisher at another site", len(data), limits.HEADER_MAX)
        try:
            fields = msgspec.json.decode(data)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise RemoteProtocolError(f"the header of a publisher at another site is no JSON: {error}") from error
        if not isinstance(fields, dict):
            raise RemoteProtocolError("the header of a publisher at another site is no JSON object")
        type_name, md5sum, definition, node = (_text(fields, key) for key in ("type", "md5sum", "definition", "node"))
        if not is_type_name(type_name):
            raise RemoteProtocolError(f"another site names the type {type_name[:80]!r}")
        if len(md5sum) != 32 or not _HEX.issuperset(md5sum):
            raise RemoteProtocolError(f"another site names the md5 sum {md5sum[:80]!r}")
        numbers = {key: _number(fields, key) for key in ("run", "sequence", "waiting")}
        description = TopicDescription(type_name, md5sum, definition, fields.get("latching") is True)
        return cls(description, node, **numbers)


def _text(fields: Mapping[str, object], key: str) -> str:
    value = fields.get(key, "")
    if not isinstance(value, str):
        raise RemoteProtocolError(f"the header of a publisher at another site has a {key} that is no text")
    return value


def _number(fields: Mapping[str, object], key: str) -> int:
    value = fields.get(key, 0)
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= _COUNT_MAX:
        raise RemoteProtocolError(f"the header of a publisher at another site has a {key} that is no count")
    return value
