"""Services over TCPROS: connection headers, requests and replies (wiki.ros.org/ROS/TCPROS, section 1.1).

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

from rmpa.core.errors import ConfigError, LimitExceeded
from rmpa.ros import limits
from rmpa.ros.wire.tcpros import ANY, LENGTH, printable

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.ros.wire.tcpros import Buffer, Header

REPLY: Final = struct.Struct("<BI")
"""The head of a reply: the ``ok`` byte and the length of the body."""
_SCHEME: Final = "rosrpc://"
_TRUE: Final = ("1", "true")


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


# --- headers --------------------------------------------------------------------------------------------------


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


def is_persistent(fields: Mapping[str, str]) -> bool:
    """Whether a client calls several times over one connection: ``1`` or ``true`` in any case."""
    return fields.get("persistent", "").lower() in _TRUE


def is_probe(fields: Mapping[str, str]) -> bool:
    """Whether a client asks only for the description, and will send no request."""
    return fields.get("probe", "").lower() in _TRUE


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


# --- requests and replies -------------------------------------------------------------------------------------


def frame_reply(ok: bool, body: Buffer) -> tuple[bytes, Buffer]:
    """A reply's head and its body; for ``ok=False`` the body is the text of the error."""
    return REPLY.pack(ok, len(body)), body


def parse_request_length(data: Buffer) -> int | None:
    """The length of the request that begins here, or ``None`` without enough bytes."""
    if len(data) < LENGTH.size:
        return None
    size: int = LENGTH.unpack_from(data)[0]
    return size


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
