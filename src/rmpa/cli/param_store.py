"""The parameters that ``rmpa param`` reads and writes: a ROS master's, or a peer's through this machine's agent."""

from __future__ import annotations

import asyncio
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

from rmpa.bridge.params.rules import key_problem
from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError, RmpaError, UnreachableError
from rmpa.core.identity import is_legal_name
from rmpa.observe import limits
from rmpa.observe.control_client import ControlClient, choose_agent
from rmpa.observe.peers_section import PeerParams, parameters_in

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.cli.master import Master
    from rmpa.cli.options import GraphOptions
    from rmpa.ros.wire.xmlrpc import RosReply, XmlRpcValue

_CALLER: Final = "/rmpa_param"
_FOR_ALL: Final = 30.0
"""Seconds for one call of a master: it may bring megabytes of XML, from a busy machine."""


class ParamStore(Protocol):
    """The parameters of one master."""

    @property
    def title(self) -> str:
        """The master or peer, for error texts."""
        ...

    def get(self, key: str) -> XmlRpcValue:
        """A value, or a namespace.

        Raises:
            RmpaError: There is none; the text offers the nearest name.
        """
        ...

    def names(self) -> list[str]:
        """The names of all parameters, in order."""
        ...

    def set(self, key: str, value: XmlRpcValue) -> int:
        """Set a parameter, or each member of a namespace; return the number. If one cannot be set, none is."""
        ...

    def delete(self, key: str) -> None:
        """Delete a parameter or namespace.

        Raises:
            RmpaError: There is none.
        """
        ...


def open_store(peer: str | None, options: GraphOptions) -> ParamStore:
    """The parameters that the options name.

    Args:
        peer: The peer whose module is meant; ``None``: a master's parameters.
        options: Master and agent.

    Raises:
        ConfigError: Both ``--peer`` and ``--master`` are given.
        RmpaError: There is no such agent.
    """
    if peer is None:
        return _MasterStore(options.master())
    if options.master_uri is not None:
        raise ConfigError("--peer", "a peer is asked through this machine's agent, not at a master", "leave one out")
    agent = choose_agent(os.environ, options.agent)
    return PeerParams(ControlClient(agent.path, limits.CONTROL_HANDLER_TIMEOUT), peer)


def split_peer(peer: str | None, text: str) -> tuple[str | None, str]:
    """The peer and the name that are meant, by ``--peer`` or as ``PEER:/name``.

    Args:
        peer: The option's value.
        text: What the user wrote as the name; a parameter's own name has no colon.

    Raises:
        ConfigError: Both name a peer.
    """
    before, colon, name = text.partition(":")
    if not colon or not before:
        return peer, text
    if peer is not None:
        raise ConfigError("--peer", f"{text!r} names a peer too", "leave one out")
    return before, name or "/"


def read_key(text: str, environ: Mapping[str, str], *, root: bool = False) -> str:
    """The global name of a parameter; a relative one is resolved in ROS_NAMESPACE.

    Args:
        text: What the user wrote.
        environ: The environment.
        root: Whether an empty text means the whole namespace.

    Raises:
        ConfigError: It is no parameter's name.
    """
    from rmpa.core.identity import resolve_name

    namespace = environ.get("ROS_NAMESPACE") or "/"
    if not text and root:
        return resolve_name("", namespace if is_legal_name(namespace) else "/")
    if text.startswith("~"):
        raise ConfigError("KEY", f"{text!r} is private to a node", "write the node's name in front: /node/name")
    key = text if text.startswith("/") else f"{namespace.rstrip('/')}/{text}"
    key = "/" + key.strip("/")
    if problem := key_problem(key):
        raise ConfigError("KEY", problem, "one looks like /robot_description")
    return key


def absent(key: str, names: list[str], title: str) -> RmpaError:
    """The error for a parameter that is not there."""
    known = {name for full in names for name in _with_namespaces(full)}
    near = did_you_mean(key, known)
    return RmpaError(f"{title} has no parameter {key}; " + (f"did you mean {near}?" if near else "`rmpa param list`"))


def _with_namespaces(name: str) -> list[str]:
    parts = name.split("/")
    return ["/".join(parts[:end]) for end in range(2, len(parts) + 1)]


@dataclass
class _MasterStore:
    """The parameters of a ROS master, an agent's core or any other."""

    master: Master

    @property
    def title(self) -> str:
        return self.master.uri

    def get(self, key: str) -> XmlRpcValue:
        reply = self._call("getParam", key)
        if reply.code != 1:
            raise absent(key, self.names(), self.title)
        return reply.value

    def names(self) -> list[str]:
        value = self._call("getParamNames").value
        return sorted(str(name) for name in value) if isinstance(value, list) else []

    def set(self, key: str, value: XmlRpcValue) -> int:
        from rmpa.ros.wire.xmlrpc import serialize_response

        parameters = parameters_in(key, value)
        serialize_response(value)  # a value that XML-RPC cannot hold is an error before anything is set
        for name, one in parameters:
            reply = self._call("setParam", name, one)
            if reply.code != 1:
                raise RmpaError(f"{self.title} does not set {name}: {reply.status}")
        return len(parameters)

    def delete(self, key: str) -> None:
        reply = self._call("deleteParam", key)
        if reply.code != 1:
            raise absent(key, self.names(), self.title)

    def _call(self, method: str, *params: XmlRpcValue) -> RosReply:
        from rmpa.ros.http.rpc import call_api

        try:
            return asyncio.run(call_api(self.master.uri, method, _CALLER, *params, timeout=_FOR_ALL))
        except UnreachableError:
            raise self.master.unreachable() from None
