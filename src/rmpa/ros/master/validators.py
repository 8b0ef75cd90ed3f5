"""Checks of the Master API's parameters: they refuse what rosmaster answers with code -1.

They are stricter in one point: ``limits.PARAM_DEPTH_MAX`` bounds the namespaces in a parameter's name.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from rmpa.ros import limits
from rmpa.ros.master.registrations import ANY_TYPE
from rmpa.ros.master.resolution import resolve
from rmpa.ros.wire.xmlrpc import XmlRpcValue, brief


class InvalidParameterError(Exception):
    """A parameter that the caller has to correct; the text names it and the fault. ``MasterApi.call`` catches it."""


Validator: TypeAlias = Callable[[XmlRpcValue, str, str], XmlRpcValue]
"""``(value, the parameter's name, caller id) -> the value to use``; raises ``InvalidParameterError``."""


def anything(value: XmlRpcValue, name: str, caller_id: str) -> XmlRpcValue:  # noqa: ARG001 - a Validator
    """Accept every value."""
    return value


def text(value: XmlRpcValue, name: str, caller_id: str) -> str:  # noqa: ARG001 - a Validator
    """A string that is not empty."""
    if not isinstance(value, str) or not value:
        raise InvalidParameterError(f"{name} must be a non-empty string, not {brief(value)}")
    return value


def key(value: XmlRpcValue, name: str, caller_id: str) -> str:
    """A parameter's name, resolved."""
    resolved = resolve(text(value, name, caller_id), caller_id)
    if resolved.count("/") > limits.PARAM_DEPTH_MAX:
        raise InvalidParameterError(f"{name} has more than {limits.PARAM_DEPTH_MAX} namespaces")
    return resolved


def node_name(value: XmlRpcValue, name: str, caller_id: str) -> str:
    """A graph name, resolved; one with a colon or a space is refused."""
    given = text(value, name, caller_id)
    if ":" in given or " " in given:
        raise InvalidParameterError(f"{name} {brief(given)} is not a graph name: it has a colon or a space in it")
    return resolve(given, caller_id)


def resource(value: XmlRpcValue, name: str, caller_id: str) -> str:
    """The name of a topic or service, resolved; not the root."""
    resolved = node_name(value, name, caller_id)
    if value == "/":
        raise InvalidParameterError(f"{name} cannot be the root namespace")
    return resolved


def subgraph(value: XmlRpcValue, name: str, caller_id: str) -> str:
    """A namespace, resolved, or the empty string for all."""
    if not isinstance(value, str):
        raise InvalidParameterError(f"{name} must be a string, not {brief(value)}")
    return resolve(value, caller_id) if value else ""


def uri(value: XmlRpcValue, name: str, caller_id: str) -> str:  # noqa: ARG001 - a Validator
    """A URI of a slave API or service, kept unchanged: roscpp recognises itself by the exact text."""
    if not isinstance(value, str) or not value.startswith(("http://", "rosrpc://")):
        raise InvalidParameterError(f"{name} must be a URI like http://host:port/ or rosrpc://host:port")
    return value


def type_name(value: XmlRpcValue, name: str, caller_id: str) -> str:  # noqa: ARG001 - a Validator
    """``package/Name``, or ``*`` for any type."""
    if not isinstance(value, str) or (value != ANY_TYPE and value.count("/") != 1):
        raise InvalidParameterError(f"{name} must be a type like std_msgs/String or *, not {brief(value)}")
    return value
