"""What two bridges say to each other: one JSON object a control frame, its kind in ``op``.

JSON because it is rare (never on the data path), bounded by ``limits.CONTROL_PAYLOAD_MAX`` and readable in a
packet capture. ``docs/design/protocol.md`` lists the messages with examples.
"""

from __future__ import annotations

import math
import re
from typing import Final

import msgspec

from rmpa.core import limits
from rmpa.core.contract import Contract
from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.names import is_global_name, is_type_name


class Source(msgspec.Struct, frozen=True, order=True):
    """One stream of messages: a topic as one node publishes it. Sources are never mixed.

    Args:
        topic: Global name of the topic, in the publishing module.
        node: Global name of the publishing node, in the publishing module.
    """

    topic: str
    node: str

    def __str__(self) -> str:
        """``/cmd from /joy_node``."""
        return f"{self.topic} from {self.node}"


class Offer(msgspec.Struct, frozen=True):
    """A source that the sender's graph has, and its message type."""

    topic: str
    node: str
    type: str

    @property
    def source(self) -> Source:
        """The stream that is offered."""
        return Source(self.topic, self.node)


class Description(msgspec.Struct, frozen=True):
    """What the publisher's own connection header says; known only once somebody is connected to it.

    Args:
        type: Message type.
        md5: Its MD5 sum, never ``*``.
        definition: The full text of its definition, byte for byte as the publisher sent it: one character a byte
            (ISO 8859-1), for some definitions have comments that are not UTF-8.
        latching: Whether each new subscriber gets the last message.
    """

    type: str
    md5: str
    definition: str
    latching: bool

    @property
    def problem(self) -> str:
        """Why a publisher with this header cannot be passed on, or empty."""
        if not is_type_name(self.type):
            return f"its publisher names no message type (but {self.type!r})"
        if not _MD5.fullmatch(self.md5):
            return f"its publisher names no md5 sum (but {self.md5!r})"
        if not self.definition.isascii() and max(self.definition) > "\xff":
            return "its definition has characters that are no bytes"
        return ""


class Advertise(msgspec.Struct, frozen=True, tag_field="op", tag="advertise"):
    """What the sender's graph publishes: all of it, first on each link, or what changed.

    Args:
        added: New, or of another type.
        removed: No longer there.
        full: This begins all of it: what is not offered is not there.
        more: Further messages go on with that.
    """

    added: tuple[Offer, ...] = ()
    removed: tuple[Source, ...] = ()
    full: bool = False
    more: bool = False


class Open(msgspec.Struct, frozen=True, tag_field="op", tag="open"):
    """Send me this source; its data frames shall bear this route's id, which I chose.

    Args:
        route: The id.
        topic: The source's topic.
        node: The source's node.
        contract: What the receiver asks for.
        epoch: The numbering that it has a part of, if a link fell in between; else 0.
        after: The last message of that which it has.
    """

    route: int
    topic: str
    node: str
    contract: Contract = Contract()
    epoch: int = 0
    after: int = 0

    @property
    def source(self) -> Source:
        """The stream that is asked for."""
        return Source(self.topic, self.node)


class Opened(msgspec.Struct, frozen=True, tag_field="op", tag="opened"):
    """The route is open; data follows.

    Args:
        route: The id.
        description: What the messages are.
        contract: What holds for the route: the stronger of both sides' words.
        epoch: Names the numbering of a reliable route, else 0.
        first: The numbering's first sequence.
    """

    route: int
    description: Description
    contract: Contract = Contract()
    epoch: int = 0
    first: int = 1


class Close(msgspec.Struct, frozen=True, tag_field="op", tag="close"):
    """I want no more of this route."""

    route: int


class Closed(msgspec.Struct, frozen=True, tag_field="op", tag="closed"):
    """The route is not, or no longer, open on my side; ``reason`` is for people."""

    route: int
    reason: str


class Mismatch(msgspec.Struct, frozen=True, tag_field="op", tag="mismatch"):
    """A node of mine wants your source with another definition; it was refused. For your log and users."""

    topic: str
    node: str
    subscriber: str
    text: str

    @property
    def source(self) -> Source:
        """The stream that did not fit."""
        return Source(self.topic, self.node)


Message = Advertise | Open | Opened | Close | Closed | Mismatch

_ENCODER: Final = msgspec.json.Encoder()
_DECODER: Final = msgspec.json.Decoder(Message)
_MD5: Final = re.compile(r"[0-9a-f]{32}")
_ROUTE_MAX: Final = (1 << 32) - 1


def is_crossing_name(name: str) -> bool:
    """Whether a topic's or node's name may be in a message: a global one that is not too long."""
    return len(name) <= limits.CROSSING_NAME_MAX and is_global_name(name)


def is_crossing_type(name: str) -> bool:
    """Whether a type's name may be in a message."""
    return len(name) <= limits.CROSSING_NAME_MAX and is_type_name(name)


def encode(message: Message) -> bytes:
    """One message as the payload of a control frame."""
    return _ENCODER.encode(message)


def decode(payload: bytes | bytearray | memoryview) -> Message:
    """Read and validate one message.

    Raises:
        LimitExceeded: It is longer than ``limits.CONTROL_PAYLOAD_MAX``, or offers too many topics.
        RemoteProtocolError: It is not a message of this version, or holds what is not a ROS name or type.
    """
    if len(payload) > limits.CONTROL_PAYLOAD_MAX:
        raise LimitExceeded("control message", len(payload), limits.CONTROL_PAYLOAD_MAX)
    try:
        message: Message = _DECODER.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise RemoteProtocolError(f"control message: {error}") from error
    _validate(message)
    return message


def _validate(message: Message) -> None:
    if not isinstance(message, Advertise | Mismatch) and not 0 < message.route <= _ROUTE_MAX:
        raise RemoteProtocolError(f"route {message.route} is not a 32-bit number above 0")
    if isinstance(message, Advertise):
        if len(message.added) > limits.TOPICS_PER_PEER_MAX:
            raise LimitExceeded("advertisement (in topics)", len(message.added), limits.TOPICS_PER_PEER_MAX)
        for offer in message.added:
            _check_names(offer.topic, offer.node)
            if not is_crossing_type(offer.type):
                raise RemoteProtocolError(f"{offer.type[:200]!r}, offered for {offer.topic}, is not a message type")
        for source in message.removed:
            _check_names(source.topic, source.node)
    elif isinstance(message, Open):
        _check_names(message.topic, message.node)
        _check_terms(message)
    elif isinstance(message, Mismatch):
        _check_names(message.topic, message.node)
        _check_text(message.subscriber)
        _check_text(message.text)
    elif isinstance(message, Closed):
        _check_text(message.reason)
    elif isinstance(message, Opened):
        if message.description.problem:
            raise RemoteProtocolError(f"route {message.route}: {message.description.problem}")
        _check_terms(message)


def _check_terms(message: Open | Opened) -> None:
    """A contract that a peer sends must be one that our own file could have."""
    contract = message.contract
    numbers = (message.epoch, message.after if isinstance(message, Open) else message.first)
    times = (contract.deadline, contract.lifespan, contract.liveliness_lease)
    lowest, highest = limits.CONTRACT_TIME_MIN, limits.CONTRACT_TIME_MAX
    lowest_rate = limits.CONTRACT_RATE_MIN
    if not 1 <= contract.depth <= limits.CONTRACT_DEPTH_MAX:
        problem = f"a depth of {contract.depth}"
    elif any(t is not None and not (math.isfinite(t) and lowest <= t <= highest) for t in times):
        problem = f"times of {times} seconds"
    elif contract.max_rate is not None and not lowest_rate <= contract.max_rate <= limits.CONTRACT_RATE_MAX:
        problem = f"a rate of {contract.max_rate}"
    elif any(not 0 <= number <= _ROUTE_MAX for number in numbers):
        problem = f"the numbers {numbers}"
    else:
        return
    raise RemoteProtocolError(f"route {message.route}: a contract with {problem} cannot be")


def _check_names(topic: str, node: str) -> None:
    for name in (topic, node):
        if not is_crossing_name(name):
            raise RemoteProtocolError(f"{name[:200]!r} is not a global ROS name")


def _check_text(text: str) -> None:
    if len(text) > limits.CONTROL_TEXT_MAX:
        raise LimitExceeded("text in a control message", len(text), limits.CONTROL_TEXT_MAX)
