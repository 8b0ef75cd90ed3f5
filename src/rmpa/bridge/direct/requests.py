"""The arguments of the requests and notifications about direct transport, as JSON.

Topics and services have the same three messages: ``direct.topic`` or ``direct.service`` asks, ``…_again`` makes the
asking side ask again, ``…_release`` gives a grant back. docs/design/protocol.md has examples.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import msgspec

from rmpa.bridge.messages import check_contract, is_crossing_name
from rmpa.core.contract import Contract  # noqa: TC001 - msgspec reads the annotations
from rmpa.core.errors import RemoteProtocolError


class Want(NamedTuple):
    """What is to be reached directly.

    Args:
        name: The topic or service, by its name on the wire.
        node: The node that publishes or provides it.
        user: The subscribing node; empty: a service, for every node of the asking module.
    """

    name: str
    node: str
    user: str = ""


class DirectAsk(msgspec.Struct, frozen=True, omit_defaults=True):
    """May this be reached directly?

    Args:
        name: As in ``Want``.
        node: As in ``Want``.
        user: As in ``Want``.
        contract: What the subscriber's module asks for; topics only.
        broken: Whether an earlier connection ended by itself, so that the publisher may be dead.
    """

    name: str
    node: str
    user: str = ""
    contract: Contract | None = None
    broken: bool = False

    @property
    def want(self) -> Want:
        """What is asked for."""
        return Want(self.name, self.node, self.user)


def write(asked: DirectAsk) -> dict[str, Any]:
    """The arguments as values that JSON can represent."""
    values: dict[str, Any] = msgspec.to_builtins(asked)
    return values


def read_ask(args: dict[str, Any]) -> DirectAsk:
    """Read and validate a request; it is about a topic if it has a user and a contract.

    Raises:
        RemoteProtocolError: A name or a value is invalid.
    """
    try:
        found = msgspec.convert(args, DirectAsk)
    except (msgspec.ValidationError, RecursionError) as error:
        raise RemoteProtocolError(f"direct transport: {error}") from error
    if bool(found.user) != (found.contract is not None):
        raise RemoteProtocolError("direct transport: a subscriber has a contract, and a service has neither")
    for name in found.want if found.user else found.want[:2]:
        if not is_crossing_name(name):
            raise RemoteProtocolError(f"direct transport: {name[:200]!r} is not a global ROS name")
    if found.contract is not None:
        check_contract(found.contract, found.name)
    return found


def read_want(args: dict[str, Any]) -> Want:
    """Read and validate a notification; errors as ``read_ask``."""
    names = args.get("name"), args.get("node"), args.get("user", "")
    for name in names if names[2] else names[:2]:
        if not isinstance(name, str) or not is_crossing_name(name):
            raise RemoteProtocolError(f"direct transport: {str(name)[:200]!r} is not a global ROS name")
    return Want(*map(str, names))
