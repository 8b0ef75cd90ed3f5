"""The arguments of the requests and notifications about direct calls of services, as JSON. Pure.

docs/design/protocol.md has examples.
"""

from __future__ import annotations

from typing import Any, Final, TypeVar

import msgspec

from rmpa.bridge import limits
from rmpa.bridge.messages import is_crossing_name
from rmpa.core.contract import Transport  # noqa: TC001 - msgspec reads the annotation
from rmpa.core.errors import RemoteProtocolError

SERVICE: Final = "direct.service"
"""Request: may the nodes of this module call the server of this service directly? The response is as to
``direct.open``."""
SERVICE_CLOSE: Final = "direct.service_close"
"""Notification: the clients' agent does not use what was permitted any more."""
SERVICE_CLOSED: Final = "direct.service_closed"
"""Notification: the server's agent withdraws what it has permitted."""
SERVICE_RETRY: Final = "direct.service_retry"
"""Notification: what was refused may be permitted now."""
_Kind = TypeVar("_Kind", "AskService", "CloseService", "ServiceDirectClosed", "RetryService")


class AskService(msgspec.Struct, frozen=True):
    """``direct.service``: a service by its name on the wire, its node, and the transport that is asked for."""

    service: str
    node: str
    transport: Transport


class CloseService(msgspec.Struct, frozen=True):
    """``direct.service_close``."""

    service: str
    node: str


class ServiceDirectClosed(msgspec.Struct, frozen=True):
    """``direct.service_closed``; ``why`` is a ``Condition``; ``node`` makes the clients' agent ask again."""

    service: str
    node: str
    why: str
    text: str


class RetryService(msgspec.Struct, frozen=True):
    """``direct.service_retry``."""

    service: str
    node: str


def write(arguments: AskService | CloseService | ServiceDirectClosed | RetryService) -> dict[str, Any]:
    """The arguments as values that JSON can represent."""
    values: dict[str, Any] = msgspec.to_builtins(arguments)
    return values


def read_ask(args: dict[str, Any]) -> AskService:
    """Read and validate ``direct.service``.

    Raises:
        RemoteProtocolError: A name or a value is invalid.
    """
    return _read(args, AskService)


def read_close(args: dict[str, Any]) -> CloseService:
    """Read and validate ``direct.service_close``; errors as ``read_ask``."""
    return _read(args, CloseService)


def read_closed(args: dict[str, Any]) -> ServiceDirectClosed:
    """Read and validate ``direct.service_closed``; errors as ``read_ask``."""
    found = _read(args, ServiceDirectClosed)
    if len(found.text) > limits.CONTROL_TEXT_MAX:
        raise RemoteProtocolError(f"a reason of {len(found.text)} characters")
    return found


def read_retry(args: dict[str, Any]) -> RetryService:
    """Read and validate ``direct.service_retry``; errors as ``read_ask``."""
    return _read(args, RetryService)


def _read(args: dict[str, Any], kind: type[_Kind]) -> _Kind:
    try:
        found = msgspec.convert(args, kind)
    except (msgspec.ValidationError, RecursionError) as error:
        raise RemoteProtocolError(f"direct calls: {error}") from error
    for name in (found.service, found.node):
        if not is_crossing_name(name):
            raise RemoteProtocolError(f"direct calls: {name[:200]!r} is not a global ROS name")
    return found
