"""TCPROS: connection headers, messages, and services (wiki.ros.org/ROS/TCPROS).

Services over TCPROS: connection headers, requests and replies (wiki.ros.org/ROS/TCPROS, section 1.1).

Pure: bytes in, values out. A client connects, both sides send a header, then the client sends a request with its
length in front and the server answers with a byte for success, a length, and the response or the text of an error.
One request is under way on a connection at a time; without ``persistent`` the server closes after its reply.

Names and md5 sums are compared as rospy and roscpp 1.15 do: literally, ``*`` matching every sum.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import ConfigError, LimitExceeded, RemoteProtocolError
from rmpa.ros import limits

if TYPE_CHECKING:
    from collections.abc import Mapping


# TCPROS. Connection headers and message framing (wiki.ros.org/ROS/TCPROS, wiki.ros.org/ROS/Connection%20Header).
#
# Pure: bytes in, values out. Each side of a connection sends one header; the publisher alone decides whether they
# match (``check_subscriber``). After the headers messages follow, each with its length in front. All integers are
# little-endian 32-bit.
#
# Where the wiki leaves something open, this module does what rospy and roscpp 1.15 both accept. Unlike them it checks
# each length before it stores anything.


# The fields of a connection header. Bytes that are not UTF-8 are kept as lone surrogates (PEP 383).
Header = dict[str, str]

Buffer = bytes | bytearray | memoryview

# The length in front of headers, fields and messages.
LENGTH: Final = struct.Struct("<I")
# The type or md5 sum of a subscriber that accepts any type.
ANY: Final = "*"
_SHOWN: Final = 200


@dataclass(frozen=True, slots=True)
class TopicDescription:
    """A publisher's description of its messages.

    Args:
        type: ``package/Name``.
        md5sum: Of the definition, 32 hexadecimal digits.
        definition: The full text with all embedded types, as the publisher sent it; may be empty.
        latching: Whether the last message is sent to later subscribers.
    """

    type: str
    md5sum: str
    definition: str
    latching: bool = False

    @classmethod
    def from_header(cls, fields: Mapping[str, str]) -> TopicDescription:
        """Read a publisher's reply header; missing fields are empty."""
        return cls(
            fields.get("type", ""),
            fields.get("md5sum", ""),
            fields.get("message_definition", ""),
            fields.get("latching") == "1",
        )

    def __str__(self) -> str:
        """``type/md5``, as ROS writes it; safe to log."""
        return f"{printable(self.type)}/{printable(self.md5sum)}"


# What a subscriber that accepts any type asks for.
ANYTHING: Final = TopicDescription(ANY, ANY, "")


def printable(text: str) -> str:
    """Make received text safe for logs and terminals: replace control characters and surrogates, cut long text."""
    shown = text if len(text) <= _SHOWN else text[:_SHOWN] + "…"
    return "".join(c if c.isprintable() else "�" for c in shown)


def pack_text(text: str) -> bytes:
    """A string of a message."""
    data = text.encode(errors="replace")
    return LENGTH.pack(len(data)) + data


def encode_header(fields: Mapping[str, str]) -> bytes:
    """A header with its length, its fields sorted by name as rospy does."""
    parts = []
    for key in sorted(fields):
        field = f"{key}={fields[key]}".encode(errors="surrogateescape")
        parts.append(LENGTH.pack(len(field)) + field)
    body = b"".join(parts)
    return LENGTH.pack(len(body)) + body


def decode_header(body: Buffer) -> Header:
    """Read the fields of a header without its leading length.

    A field is split at its first ``=`` and blanks around its name are stripped, as rospy does; of two fields with one
    name the last one counts.

    Raises:
        RemoteProtocolError: A field is empty, has no ``=``, or is longer than the rest of the header.
    """
    fields: Header = {}
    view = memoryview(body)
    start = 0
    while start < len(view):
        if len(view) - start < LENGTH.size:
            raise RemoteProtocolError(f"connection header ends within a length, {len(view) - start} bytes left over")
        (size,) = LENGTH.unpack_from(view, start)
        start += LENGTH.size
        if size == 0:
            raise RemoteProtocolError("connection header has a field of length 0")
        if size > len(view) - start:
            raise RemoteProtocolError(f"connection header field of {size} bytes where {len(view) - start} are left")
        field = str(view[start : start + size], "utf-8", "surrogateescape")
        start += size
        key, separator, value = field.partition("=")
        if not separator:
            raise RemoteProtocolError(f"connection header field without '=': {printable(field)!r}")
        fields[key.strip()] = value
    return fields


def parse_header(data: Buffer) -> tuple[Header | None, int, int]:
    """Read a header from the front of the received bytes.

    Returns:
        ``(fields, consumed, wanted)``; without enough bytes ``(None, 0, wanted)``, where ``wanted`` is the number of
        bytes that is needed in all.

    Raises:
        LimitExceeded: The header claims more than ``limits.TCPROS_HEADER_MAX``.
        RemoteProtocolError: See ``decode_header``.
    """
    if len(data) < LENGTH.size:
        return None, 0, LENGTH.size
    (size,) = LENGTH.unpack_from(data)
    if size > limits.TCPROS_HEADER_MAX:
        raise LimitExceeded("connection header", size, limits.TCPROS_HEADER_MAX)
    end = LENGTH.size + size
    if len(data) < end:
        return None, 0, end
    return decode_header(memoryview(data)[LENGTH.size : end]), end, LENGTH.size


def frame_message(payload: Buffer) -> bytes:
    """A message with its length in front.

    Raises:
        ValueError: The message is longer than ``limits.TCPROS_MESSAGE_MAX``.
    """
    if len(payload) > limits.TCPROS_MESSAGE_MAX:
        raise ValueError(f"message of {len(payload)} bytes exceeds the limit of {limits.TCPROS_MESSAGE_MAX}")
    return b"".join((LENGTH.pack(len(payload)), payload))


def split_messages(data: memoryview) -> tuple[list[memoryview], int, int]:
    """Split the received bytes into whole messages.

    Returns:
        ``(messages, consumed, wanted)``: each message is a view into ``data`` with its 4-byte length in front;
        ``wanted`` is the number of bytes needed from the first unconsumed one on, as ``runtime.stream`` defines it.

    Raises:
        LimitExceeded: The first message claims more than ``limits.TCPROS_MESSAGE_MAX``. If whole messages precede
            such a message, they are returned, and the next call raises.
        RemoteProtocolError: The first message claims more than ``limits.TCPROS_LENGTH_MAX``.
    """
    messages: list[memoryview] = []
    start = 0
    filled = len(data)
    while filled - start >= LENGTH.size:
        (size,) = LENGTH.unpack_from(data, start)
        if size > limits.TCPROS_MESSAGE_MAX:
            if messages:
                break
            if size > limits.TCPROS_LENGTH_MAX:
                text = f"a message's length of {size} bytes cannot be (the most is {limits.TCPROS_LENGTH_MAX}): "
                raise RemoteProtocolError(text + "the publisher's stream is corrupt")
            raise LimitExceeded("message", size, limits.TCPROS_MESSAGE_MAX)
        end = start + LENGTH.size + size
        if end > filled:
            return messages, start, end - start
        messages.append(data[start:end])
        start = end
    return messages, start, LENGTH.size


def subscriber_header(
    topic: str, caller_id: str, wanted: TopicDescription = ANYTHING, *, nodelay: bool = True
) -> Header:
    """The header of a subscriber; an unknown definition is left out, as roscpp does."""
    fields = {
        "callerid": caller_id,
        "md5sum": wanted.md5sum,
        "tcp_nodelay": "1" if nodelay else "0",
        "topic": topic,
        "type": wanted.type,
    }
    return fields | ({"message_definition": wanted.definition} if wanted.definition else {})


def publisher_header(topic: str, caller_id: str, description: TopicDescription) -> Header:
    """The reply header of a publisher.

    Raises:
        ValueError: The description has ``*`` for its type or md5 sum. Such a type would be recorded in bags, and a
            roscpp subscriber would send it to every other publisher.
    """
    if ANY in (description.type, description.md5sum):
        raise ValueError(f"a publisher of {topic} cannot have the type {description}")
    return {
        "callerid": caller_id,
        "latching": "1" if description.latching else "0",
        "md5sum": description.md5sum,
        "message_definition": description.definition,
        "topic": topic,
        "type": description.type,
    }


def check_request(fields: Mapping[str, str]) -> str | None:
    """Check the required fields of a received header: an error text for the other side, or ``None``."""
    if "error" in fields:
        return f"an error was sent where a request was expected: {printable(fields['error'])}"
    if "topic" not in fields and "service" not in fields:
        return "neither a 'topic' nor a 'service' field in the connection header"
    for required in ("md5sum", "callerid"):
        if required not in fields:
            return f"required field '{required}' is missing in the connection header"
    return None


def check_subscriber(
    fields: Mapping[str, str], topic: str, caller_id: str, description: TopicDescription | None
) -> str | None:
    """Check whether a subscriber matches a publisher.

    The md5 sum alone decides: a subscriber that names another type with the right sum is accepted, as rospy and
    roscpp do, and ``*`` matches all.

    Args:
        fields: The subscriber's header.
        topic: The published topic, compared literally.
        caller_id: The publisher's name, for the text.
        description: The publisher's, or ``None`` while it is not known: then the md5 sum is not checked.

    Returns:
        ``None`` if it matches, else the text of the error header.
    """
    problem = check_request(fields)
    if problem is not None:
        return problem
    if fields.get("topic") != topic:
        return f"[{caller_id}] is not a publisher of [{printable(fields.get('topic', ''))}]"
    if description is None or fields["md5sum"] in (ANY, description.md5sum):
        return None
    wanted = f"{fields.get('type', '?')}/{fields['md5sum']}"
    return (
        f"client [{printable(fields['callerid'])}] wants topic {topic} to have type/md5sum [{printable(wanted)}], "
        f"but publisher [{caller_id}] has [{description}]"
    )


def check_publisher(fields: Mapping[str, str], type_name: str = ANY, md5sum: str = ANY) -> str | None:
    """Check a publisher's reply header: an error text, or ``None`` if it matches.

    rospy and roscpp only require the fields and deliver any message; here type and md5 sum are compared.

    Args:
        fields: The reply header.
        type_name: The requested type, or ``*``; it is compared where the md5 sum is not.
        md5sum: The requested md5 sum, or ``*``.
    """
    if "error" in fields:
        return printable(fields["error"])
    for required in ("type", "md5sum"):
        if not fields.get(required):
            return f"required field '{required}' is missing in the publisher's reply"
    if ANY in (fields["type"], fields["md5sum"]):
        return "the publisher's reply has '*' where a type or md5 sum must be"
    another = type_name not in (ANY, fields["type"]) if md5sum == ANY else md5sum != fields["md5sum"]
    if another:
        return (
            f"the publisher has [{printable(fields['type'])}/{printable(fields['md5sum'])}], "
            f"not [{type_name}/{md5sum}]"
        )
    return None


# The head of a reply: the ``ok`` byte and the length of the body.
REPLY: Final = struct.Struct("<BI")
_SCHEME: Final = "rosrpc://"


@dataclass(frozen=True, slots=True)
class ServiceDescription:
    """A server's description of its service.

    Args:
        type: ``package/Name``.
        md5sum: Of request and response together, 32 hexadecimal digits.
        request_type: ``package/NameRequest``.
        response_type: ``package/NameResponse``.
    """

    type: str
    md5sum: str
    request_type: str = ""
    response_type: str = ""

    @classmethod
    def from_header(cls, fields: Mapping[str, str]) -> ServiceDescription:
        """Read a server's reply header; missing fields are empty."""
        kind = fields.get("type", "")
        return cls(
            kind,
            fields.get("md5sum", ""),
            fields.get("request_type", "") or (f"{kind}Request" if kind else ""),
            fields.get("response_type", "") or (f"{kind}Response" if kind else ""),
        )

    def __str__(self) -> str:
        """``type/md5``, as ROS writes it; safe to log."""
        return f"{printable(self.type)}/{printable(self.md5sum)}"


def client_header(
    service: str, caller_id: str, *, md5sum: str = ANY, persistent: bool = False, probe: bool = False
) -> Header:
    """The header of a client."""
    fields = {"service": service, "callerid": caller_id, "md5sum": md5sum}
    if persistent:
        fields["persistent"] = "1"
    if probe:
        fields["probe"] = "1"
    return fields


def server_header(caller_id: str, description: ServiceDescription) -> Header:
    """The reply header of a server.

    Raises:
        ValueError: The description has ``*`` for its type or md5 sum; clients build messages from them.
    """
    if ANY in (description.type, description.md5sum):
        raise ValueError(f"a service cannot have the type {description}")
    return {
        "callerid": caller_id,
        "md5sum": description.md5sum,
        "request_type": description.request_type or f"{description.type}Request",
        "response_type": description.response_type or f"{description.type}Response",
        "type": description.type,
    }


def is_set(fields: Mapping[str, str], name: str) -> bool:
    """Whether a client's header has a mark: ``1`` or ``true`` in any case.

    ``persistent``: it calls several times over one connection; ``probe``: it asks only for the description.
    """
    return fields.get(name, "").lower() in ("1", "true")


def check_client(
    fields: Mapping[str, str], service: str, caller_id: str, description: ServiceDescription
) -> str | None:
    """Compare a client's md5 sum: ``None`` if it matches, else the text of the error header."""
    if fields["md5sum"] in (ANY, description.md5sum):
        return None
    return (
        f"client [{printable(fields['callerid'])}] wants service {service} to have md5sum "
        f"[{printable(fields['md5sum'])}], but server [{caller_id}] has [{description}]"
    )


def check_server(fields: Mapping[str, str], service: str, md5sum: str = ANY) -> str | None:
    """Check a server's reply header: an error text, or ``None`` if it is valid."""
    if "error" in fields:
        return printable(fields["error"])
    if not fields.get("md5sum"):
        return "required field 'md5sum' is missing in the server's reply"
    if md5sum not in (ANY, fields["md5sum"]):
        return f"the server of {service} has md5sum [{printable(fields['md5sum'])}], not [{printable(md5sum)}]"
    return None


def parse_reply_head(data: Buffer) -> tuple[bool, int] | None:
    """The ``ok`` byte of a reply and the length of its body, or ``None`` without enough bytes.

    Raises:
        LimitExceeded: The reply claims more than ``limits.SERVICE_MESSAGE_MAX``.
    """
    if len(data) < REPLY.size:
        return None
    ok, size = REPLY.unpack_from(data)
    if size > limits.SERVICE_MESSAGE_MAX:
        raise LimitExceeded("service response", size, limits.SERVICE_MESSAGE_MAX)
    return ok != 0, size


class BodyBuffer:
    """A request or response of a known size that arrives in parts; memory is allocated as bytes arrive.

    Args:
        size: The number of its bytes.
    """

    __slots__ = ("data", "size")

    def __init__(self, size: int) -> None:
        self.size = size
        self.data = bytearray()

    def take(self, part: memoryview) -> int:
        """Append the bytes that belong to this request or response; return their number."""
        mine = part[: self.size - len(self.data)]
        self.data += mine
        return len(mine)

    @property
    def whole(self) -> bool:
        """Whether all bytes have arrived."""
        return len(self.data) == self.size


def parse_service_uri(uri: str) -> tuple[str, int]:
    """Host and port of ``rosrpc://host:port``.

    Raises:
        ConfigError: The text is not such a URI.
    """
    host, _, port = uri.removeprefix(_SCHEME).rstrip("/").rpartition(":")
    number = int(port) if re.fullmatch(r"[0-9]{1,5}", port) else 0
    if not uri.startswith(_SCHEME) or not host.strip("[]") or not 0 < number < 1 << 16:
        problem = f"{printable(uri)!r} is not a service's address"
        raise ConfigError("service", problem, "one looks like rosrpc://host:port")
    return host.strip("[]"), number
