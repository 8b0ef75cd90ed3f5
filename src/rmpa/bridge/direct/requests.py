"""The arguments of the requests and notifications about direct transport, as JSON. Pure.

docs/design/protocol.md has examples.
"""

from __future__ import annotations

from typing import Any, Final, TypeVar

import msgspec

from rmpa.bridge import limits
from rmpa.bridge.messages import Source, check_contract, is_crossing_name
from rmpa.core.contract import Contract  # noqa: TC001 - msgspec reads the annotations
from rmpa.core.errors import RemoteProtocolError

OPEN: Final = "direct.open"
"""Request: may this subscriber connect to the publisher of this source?"""
CLOSE: Final = "direct.close"
"""Notification: a subscriber does not use its grant any more."""
CLOSED: Final = "direct.closed"
"""Notification: the publisher's agent withdraws grants."""
_Kind = TypeVar("_Kind")

RETRY: Final = "direct.retry"
"""Notification: what was refused may be granted now."""


class OpenDirect(msgspec.Struct, frozen=True):
    """``direct.open``: the subscriber's contract is what its module asks for."""

    topic: str
    node: str
    subscriber: str
    contract: Contract

    @property
    def source(self) -> Source:
        """The source, by its wire name."""
        return Source(self.topic, self.node)


class CloseDirect(msgspec.Struct, frozen=True, omit_defaults=True):
    """``direct.close``; ``broken``: the connection ended by itself, so the publisher may be dead."""

    topic: str
    node: str
    subscriber: str
    broken: bool = False

    @property
    def source(self) -> Source:
        """The source, by its wire name."""
        return Source(self.topic, self.node)


class DirectClosed(msgspec.Struct, frozen=True):
    """``direct.closed``: of one subscriber, or of all if ``subscriber`` is empty; ``why`` is a ``Condition``."""

    topic: str
    node: str
    subscriber: str
    why: str
    text: str

    @property
    def source(self) -> Source:
        """The source, by its wire name."""
        return Source(self.topic, self.node)


class RetryDirect(msgspec.Struct, frozen=True):
    """``direct.retry``."""

    topic: str
    node: str

    @property
    def source(self) -> Source:
        """The source, by its wire name."""
        return Source(self.topic, self.node)


Arguments = OpenDirect | CloseDirect | DirectClosed | RetryDirect


def write(arguments: Arguments) -> dict[str, Any]:
    """The arguments as values that JSON can represent."""
    values: dict[str, Any] = msgspec.to_builtins(arguments)
    return values


def read_open(args: dict[str, Any]) -> OpenDirect:
    """Read and validate ``direct.open``.

    Raises:
        RemoteProtocolError: A name or a value is invalid.
    """
    found = _read(args, OpenDirect)
    _check(found.topic, found.node, found.subscriber)
    check_contract(found.contract, found.topic)
    return found


def read_close(args: dict[str, Any]) -> CloseDirect:
    """Read and validate ``direct.close``; errors as ``read_open``."""
    found = _read(args, CloseDirect)
    _check(found.topic, found.node, found.subscriber)
    return found


def read_closed(args: dict[str, Any]) -> DirectClosed:
    """Read and validate ``direct.closed``; errors as ``read_open``."""
    found = _read(args, DirectClosed)
    _check(found.topic, found.node, *([found.subscriber] if found.subscriber else []))
    if len(found.text) > limits.CONTROL_TEXT_MAX:
        raise RemoteProtocolError(f"a reason of {len(found.text)} characters")
    return found


def read_retry(args: dict[str, Any]) -> RetryDirect:
    """Read and validate ``direct.retry``; errors as ``read_open``."""
    found = _read(args, RetryDirect)
    _check(found.topic, found.node)
    return found


def _read(args: dict[str, Any], kind: type[_Kind]) -> _Kind:
    try:
        return msgspec.convert(args, kind)
    except (msgspec.ValidationError, RecursionError) as error:
        raise RemoteProtocolError(f"direct transport: {error}") from error


def _check(*names: str) -> None:
    for name in names:
        if not is_crossing_name(name):
            raise RemoteProtocolError(f"direct transport: {name[:200]!r} is not a global ROS name")
