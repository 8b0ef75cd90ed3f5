"""The parameters of a peer's module, read and written through this machine's agent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rmpa.bridge import limits as bridge_limits
from rmpa.bridge.params import rules as transfer
from rmpa.bridge.params.rules import key_problem
from rmpa.core.errors import LocalProtocolError, PeerRefused, RmpaError
from rmpa.ros.master.parameters import leaves
from rmpa.ros.wire.xmlrpc import parse_response, serialize_response

if TYPE_CHECKING:
    from rmpa.observe.io.control_client import ControlClient
    from rmpa.ros.wire.xmlrpc import XmlRpcValue


def parameters_in(key: str, value: XmlRpcValue) -> list[tuple[str, XmlRpcValue]]:
    """The parameters in a value, each with its name.

    Raises:
        RmpaError: A name in it is not a parameter's.
    """
    found = list(leaves(key, value))
    for name, one in found:
        if name == "/":
            raise RmpaError(f"the root can only be set to a dictionary, not to {one!r}")
        if problem := key_problem(name):
            raise RmpaError(problem)
    return found


@dataclass
class PeerParams:
    """The parameters of a peer's module, through both agents; each call blocks.

    Args:
        client: Asks this machine's agent.
        peer: The peer's name or GUID.
    """

    client: ControlClient
    peer: str

    @property
    def title(self) -> str:
        """The peer, for error texts."""
        return self.peer

    def get(self, key: str) -> XmlRpcValue:
        """A value, or a namespace.

        Raises:
            RmpaError: There is none, or the peer does not answer or refuses.
        """
        return self._value(transfer.GET, key=key)

    def names(self) -> list[str]:
        """The names of all parameters that may be read, in order; errors as for ``get``."""
        value = self._value(transfer.NAMES)
        return sorted(str(name) for name in value) if isinstance(value, list) else []

    def set(self, key: str, value: XmlRpcValue) -> int:
        """Set a parameter, or each member of a namespace; return the number. Errors as for ``get``."""
        parameters_in(key, value)
        try:
            text = serialize_response(value)
        except LocalProtocolError as error:
            raise RmpaError(f"{key}: {error}") from None
        if len(text) > bridge_limits.PARAM_TEXT_MAX:
            raise RmpaError(transfer.too_large(key, len(text)))
        return transfer.count_of(self._ask(transfer.SET, key=key, text=text.decode()))

    def delete(self, key: str) -> None:
        """Delete a parameter or namespace; errors as for ``get``."""
        self._ask(transfer.DELETE, key=key)

    def _value(self, what: str, **args: str) -> XmlRpcValue:
        return parse_response(transfer.text_of(self._ask(what, **args)).encode())

    def _ask(self, what: str, **args: str) -> object:
        try:
            return self.client.call("param", dict[str, Any], peer=self.peer, what=what, **args)
        except PeerRefused as error:
            raise RmpaError(error.reason) from None  # this agent only passes on the answer of the peer's agent
