"""Services between sites: the description that a queryable gives, and the texts of calls that fail. Without I/O.

``get`` on ``rmpa/1/<site>/<module>/s/<package>%<Type>/<service>`` calls: the query's payload is the request, the
reply the response, both as TCPROS has them without length. With the parameter ``description`` it asks for the type::

    {"type": "std_srvs/Trigger", "md5sum": "937c9679…", "request_type": "std_srvs/TriggerRequest", "response_type": …}

An error reply has the server's text. The query's attachment is that of a message (``sites.attachment``): it tells
which site calls, and the md5 sum that it takes the service for; programs may leave it out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import is_type_name
from rmpa.gateway import limits
from rmpa.gateway.sites.keys import ROOT, TO, UNKNOWN_TYPE
from rmpa.ros.wire.tcpros import ServiceDescription

if TYPE_CHECKING:
    from rmpa.ros.wire.tcpros import Buffer

DESCRIPTION: Final = "description"
"""The parameter of a query for the type."""
NO_MD5: Final = "0" * 32
"""The md5 sum in the attachment of a call whose client has not asked for the type."""
_MD5_LENGTH: Final = 32


class _Described(msgspec.Struct):
    type: str
    md5sum: str
    request_type: str = ""
    response_type: str = ""


def write_description(description: ServiceDescription) -> bytes:
    """The reply to a query for the type."""
    told = _Described(description.type, description.md5sum, description.request_type, description.response_type)
    return msgspec.json.encode(told)


def read_description(data: Buffer) -> ServiceDescription:
    """Read a reply of ``write_description``.

    Raises:
        RemoteProtocolError: It is none, or names no type.
    """
    if len(data) > limits.SERVICE_DESCRIPTION_MAX:
        raise RemoteProtocolError(f"a description of a service has {len(data)} bytes")
    try:
        told = msgspec.json.decode(data, type=_Described)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise RemoteProtocolError(f"not a description of a service: {error}") from None
    hexadecimal = len(told.md5sum) == _MD5_LENGTH and not told.md5sum.strip("0123456789abcdef")
    if not is_type_name(told.type) or not hexadecimal:
        raise RemoteProtocolError(f"not a description of a service: {told.type[:80]!r}, {told.md5sum[:40]!r}")
    return ServiceDescription(told.type, told.md5sum, told.request_type, told.response_type)


def asked_type(key: str) -> str:
    """The type in the key expression of a query; ``*`` for any.

    Raises:
        RemoteProtocolError: It is not the key of a service.
    """
    chunks = key.split("/")
    if len(chunks) > 6 and chunks[4] == TO:
        del chunks[4:6]
    if len(key) > limits.KEY_MAX or len(chunks) < 7 or "/".join(chunks[:2]) != ROOT or chunks[4] != "s":
        raise RemoteProtocolError(f"{key[:120]!r} is not the key of a service")
    return UNKNOWN_TYPE if "*" in chunks[5] else chunks[5].replace("%", "/")


def type_problem(service: str, asked: str, has: str) -> str:
    """Why a call by another type is refused; empty if the types are equal or one of them is unknown."""
    if UNKNOWN_TYPE in (asked, has) or asked == has:
        return ""
    return f"service {service} is of the type {has}, not {asked}"


def md5_problem(service: str, asked: str, description: ServiceDescription) -> str:
    """Why a call by another definition of the type is refused; empty if it is not."""
    if asked in (NO_MD5, description.md5sum):
        return ""
    return (
        f"the md5 sum of service {service} is {description.md5sum} ({description.type}) at its site, and the client "
        f"takes it for {asked}: another definition, or the server was replaced; build both from the same package"
    )


def unanswered(service: str, module: str, site: str, waited: float, timeout: float) -> str:
    """What a client reads of a call that brought no reply.

    Args:
        service: By its name in its module.
        module: The module that has it.
        site: The site of the module.
        waited: Seconds until the session gave up.
        timeout: Seconds that it was to wait.
    """
    if waited < timeout:
        return f"service {service} of {module} at site {site} has left: no gateway there answers for it"
    return f"service {service} of {module} at site {site} has not answered within {timeout:g} s ([[service]] timeout)"
