"""Parameters between ROS and the Foxglove WebSocket protocol: their values, and a client's requests about them.

ROS tells integers from floating-point numbers and has byte strings; JSON does neither, so a type goes with them.
"""

from __future__ import annotations

import base64
import binascii
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from msgspec import UNSET, UnsetType

from rmpa.core.errors import RmpaError
from rmpa.core.identity import is_global_name
from rmpa.core.limits import INT32_MAX, INT32_MIN
from rmpa.web import limits
from rmpa.web.foxglove.protocol import FoxgloveParameter, ParameterValues
from rmpa.web.hub import requests

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from rmpa.web.foxglove.protocol import GetParameters, ParameterType, SetParameters
    from rmpa.web.hub.requests import ParamValue

_SHOWN: Final = 80
"""Characters of a wrong name or value in an error."""


class ParameterError(RmpaError):
    """A client's parameter has a name or a value that ROS cannot hold."""


def to_parameter(name: str, value: ParamValue) -> FoxgloveParameter:
    """A parameter as clients get it; ``None`` is one that was deleted.

    Numbers that JSON lacks (NaN, infinities) become the texts ``nan``, ``inf`` and ``-inf``, without a type.
    """
    if value is None:
        return FoxgloveParameter(name=name)
    if isinstance(value, bytes):
        return FoxgloveParameter(name=name, type="byte_array", value=base64.b64encode(value).decode())
    kind: ParameterType | UnsetType = UNSET
    if isinstance(value, float) and math.isfinite(value):
        kind = "float64"
    elif isinstance(value, list) and value and all(isinstance(each, float) and math.isfinite(each) for each in value):
        kind = "float64_array"
    return FoxgloveParameter(name=name, type=kind, value=_to_json(value))


def _to_json(value: ParamValue) -> object:
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    if isinstance(value, list):
        return [_to_json(each) for each in value]
    if isinstance(value, dict):
        return {key: _to_json(each) for key, each in value.items()}
    return value


def from_parameter(parameter: FoxgloveParameter) -> ParamValue:
    """The value of a client's parameter; ``None`` for one that is to be deleted.

    Raises:
        ParameterError: The name is no global name, or the value does not fit its type, or ROS cannot hold it.
    """
    name, value = parameter.name, parameter.value
    check_name(name)
    if value is UNSET or value is None:
        return None
    if parameter.type == "byte_array":
        if isinstance(value, str):
            try:
                return base64.b64decode(value, validate=True)
            except (binascii.Error, ValueError):
                pass
        raise ParameterError(f"{name}: a byte_array is base64 text, not {_short(value)}")
    if parameter.type == "float64":
        return _float(name, value)
    if parameter.type == "float64_array":
        if not isinstance(value, list):
            raise ParameterError(f"{name}: a float64_array is a list of numbers, not {_short(value)}")
        return [_float(name, each) for each in value]
    return _from_json(name, value, 0)


def check_name(name: str) -> None:
    """Refuse what is not a parameter's global name.

    Raises:
        ParameterError: It is none.
    """
    if not is_global_name(name):
        raise ParameterError(f"{_short(name)} is not a parameter's name; write it like /base/rate")


def _float(name: str, value: object) -> float:
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            pass
    raise ParameterError(f"{name}: a float64 is a number, not {_short(value)}")


def _from_json(name: str, value: object, depth: int) -> ParamValue:
    if depth > limits.FOXGLOVE_PARAMETER_DEPTH_MAX:
        raise ParameterError(f"{name}: lists and maps are nested deeper than {limits.FOXGLOVE_PARAMETER_DEPTH_MAX}")
    if isinstance(value, int) and not INT32_MIN <= value <= INT32_MAX:
        raise ParameterError(f"{name}: {value} does not fit an integer of 32 bits; give it the type float64")
    if isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, list):
        return [_from_json(name, each, depth + 1) for each in value]
    if isinstance(value, dict):
        return {str(key): _from_json(name, each, depth + 1) for key, each in value.items()}
    raise ParameterError(f"{name}: a parameter cannot hold {_short(value)}")


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"


@dataclass(slots=True)
class _Pending:
    """A client's request: the hub's handles that have not answered, and what the others brought."""

    id: str | None
    answered: bool
    waiting: set[int]
    values: dict[str, ParamValue] = field(default_factory=dict)


class ParameterRequests:
    """What one client has asked about parameters, and the hub's answers to it.

    Args:
        next_handle: Makes a new handle.
    """

    def __init__(self, next_handle: Callable[[], int]) -> None:
        self._next_handle = next_handle
        self._pending: dict[int, _Pending] = {}
        self._open = 0
        self._followed: dict[str, int] = {}
        self._names: dict[int, str] = {}
        self._all: int | None = None
        self._without: set[str] = set()

    def owns(self, handle: int) -> bool:
        """Whether the hub's answers with this handle belong here."""
        return handle in self._pending or handle in self._names or handle == self._all

    def get(self, message: GetParameters) -> list[requests.HubRequest]:
        """What to ask the hub for a client's ``getParameters``.

        Raises:
            ParameterError: A name is none, or too many requests wait for their answer.
        """
        for name in message.parameter_names:
            check_name(name)
        handle = self._begin(message.id, 1)[0]
        return [requests.GetParams(handle, tuple(dict.fromkeys(message.parameter_names)))]

    def set(self, message: SetParameters) -> list[requests.HubRequest]:
        """What to ask the hub for a client's ``setParameters``; one that is refused leaves all as they are.

        Raises:
            ParameterError: A name or a value is refused, or too many requests wait for their answer.
        """
        values = {each.name: from_parameter(each) for each in message.parameters}
        if not values:
            return []
        handles = self._begin(message.id, len(values), answered=message.id is not None)
        return [
            requests.DeleteParam(handle, name) if value is None else requests.SetParam(handle, name, value)
            for handle, (name, value) in zip(handles, values.items(), strict=True)
        ]

    def follow(self, names: Iterable[str]) -> list[requests.HubRequest]:
        """What to ask the hub for ``subscribeParameterUpdates``; no names are all parameters.

        Raises:
            ParameterError: A name is none, or the client follows too many.
        """
        names = dict.fromkeys(names)
        if not names:
            out = self._end_named(tuple(self._followed))
            self._without.clear()
            if self._all is None:
                self._all = self._next_handle()
                out.append(requests.FollowParams(self._all))
            return out
        for name in names:
            check_name(name)
        if self._all is not None:
            self._without.difference_update(names)
            return []
        new = [name for name in names if name not in self._followed]
        self._check_followed(len(self._followed) + len(new))
        out = []
        for name in new:
            handle = self._followed[name] = self._next_handle()
            self._names[handle] = name
            out.append(requests.FollowParams(handle, (name,)))
        return out

    def unfollow(self, names: Iterable[str]) -> list[requests.HubRequest]:
        """What to ask the hub for ``unsubscribeParameterUpdates``; no names are all parameters.

        Raises:
            ParameterError: The client follows all parameters but too many.
        """
        names = dict.fromkeys(names)
        if names and self._all is not None:
            self._check_followed(len(self._without | names.keys()))
            self._without.update(names)
            return []
        if names:
            return self._end_named(tuple(name for name in names if name in self._followed))
        out = self._end_named(tuple(self._followed))
        if self._all is not None:
            out.append(requests.UnfollowParams(self._all))
            self._all = None
            self._without.clear()
        return out

    def answer(self, answer: requests.ParamsChanged) -> ParameterValues | None:
        """What to tell the client of the hub's answer; ``None`` where more answers belong to its request, or none."""
        handle = answer.handle
        if handle in self._pending:
            return self._end(handle, answer.values)
        values = {name: value for name, value in answer.values.items() if name not in self._without}
        return _values(values) if values else None

    def failed(self, handle: int) -> ParameterValues | None:
        """Take note that a request failed; returns the answer to a client's request of which this was the last."""
        if handle in self._pending:
            return self._end(handle, {})
        if handle == self._all:
            self._all = None
        else:
            self._followed.pop(self._names.pop(handle), None)
        return None

    def close(self) -> list[requests.HubRequest]:
        """What to ask the hub when the client is gone."""
        self._pending.clear()
        return self.unfollow(())

    # --- inside -----------------------------------------------------------------------------------------------

    def _begin(self, identity: str | None, count: int, *, answered: bool = True) -> list[int]:
        if self._open >= limits.FOXGLOVE_PARAMETER_REQUESTS_MAX:
            raise ParameterError(
                f"{self._open} requests for parameters wait for their answer, which is the limit; try again later"
            )
        handles = [self._next_handle() for _ in range(count)]
        pending = _Pending(identity, answered, set(handles))
        self._open += 1
        for handle in handles:
            self._pending[handle] = pending
        return handles

    def _end(self, handle: int, values: Mapping[str, ParamValue]) -> ParameterValues | None:
        pending = self._pending.pop(handle)
        pending.waiting.discard(handle)
        pending.values.update(values)
        if pending.waiting:
            return None
        self._open -= 1
        if not pending.answered:
            return None
        return _values({n: v for n, v in pending.values.items() if v is not None}, pending.id)

    def _end_named(self, names: tuple[str, ...]) -> list[requests.HubRequest]:
        out: list[requests.HubRequest] = []
        for name in names:
            handle = self._followed.pop(name)
            del self._names[handle]
            out.append(requests.UnfollowParams(handle))
        return out

    def _check_followed(self, count: int) -> None:
        if count > limits.FOXGLOVE_PARAMETERS_MAX:
            raise ParameterError(
                f"{count} parameters are more than the {limits.FOXGLOVE_PARAMETERS_MAX} that a client may name;"
                " follow all by an empty list"
            )


def _values(values: Mapping[str, ParamValue], identity: str | None = None) -> ParameterValues:
    return ParameterValues(
        parameters=tuple(to_parameter(name, value) for name, value in values.items()),
        id=identity if identity is not None else UNSET,
    )
