"""The channels and services that a Foxglove client is offered, from the graph and the definitions of its types.

A topic has one channel for each of its types, and for each version of a type that its messages have (by the md5 sum):
where publishers disagree there are several, which differ in their schema. A channel or a service is offered once its
definition is known, and has an id that is never used again.
"""

from __future__ import annotations

import base64
import binascii
import itertools
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, TypeVar

from msgspec import UNSET, UnsetType

from rmpa.core.errors import RmpaError
from rmpa.core.identity import is_global_name, is_type_name
from rmpa.core.limits import INT32_MAX, INT32_MIN
from rmpa.web import limits
from rmpa.web.foxglove.protocol import (
    ENCODING,
    SCHEMA_ENCODING,
    Channel,
    FoxgloveAdvertise,
    FoxgloveAdvertiseServices,
    FoxgloveParameter,
    FoxgloveService,
    FoxgloveStatus,
    FoxgloveUnadvertise,
    FoxgloveUnadvertiseServices,
    ParameterValues,
    RemoveStatus,
    ServiceSchema,
    StatusLevel,
)
from rmpa.web.hub import requests

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from rmpa.web.foxglove.protocol import GetParameters, ParameterType, ServerMessage, SetParameters
    from rmpa.web.hub.requests import GraphChanged, ParamValue

_SEPARATOR: Final = "=" * 80
_T = TypeVar("_T")


@dataclass(slots=True)
class _Type:
    """A type that the hub was asked for: its request's handle, and its definition once that is known."""

    handle: int
    name: str
    service: bool
    md5sum: str = ""
    described: requests.Described | None = None
    warned: bool = False


class ChannelTable:
    """Channels and services of one client.

    Args:
        next_handle: Makes a new handle.
        services: Whether the client may call services; else it is offered none.
    """

    def __init__(self, next_handle: Callable[[], int], *, services: bool) -> None:
        self._next_handle = next_handle
        self._with_services = services
        self._channel_ids = itertools.count(1)
        self._service_ids = itertools.count(1)
        self._types: dict[tuple[str, bool, str], _Type] = {}
        self._asked: dict[int, _Type] = {}
        self._searched: dict[int, str] = {}
        self._found: dict[str, str | None] = {}
        self._pairs: dict[tuple[str, str], None] = {}
        self._versions: dict[tuple[str, str], dict[str, None]] = {}
        self._wanted: dict[tuple[str, str, str], None] = {}
        self._wanted_services: dict[tuple[str, str], None] = {}
        self._by_key: dict[tuple[str, str, str], Channel] = {}
        self._services_by_key: dict[tuple[str, str], FoxgloveService] = {}
        self.channels: dict[int, Channel] = {}
        """What is offered, by id."""
        self.services: dict[int, FoxgloveService] = {}
        """Likewise."""
        self.md5sums: dict[int, str] = {}
        """The md5 sum of each channel's schema, by the channel's id; "" where the hub does not tell it."""

    def owns(self, handle: int) -> bool:
        """Whether the hub's answers with this handle belong here."""
        return handle in self._asked or handle in self._searched

    def update(self, graph: GraphChanged) -> Iterator[ServerMessage | requests.HubRequest]:
        """Offer what is new in the graph, withdraw what is gone, and ask for the types that are not known yet."""
        self._pairs = {
            (topic.name, type_): None
            for topic in graph.topics
            if topic.publishers
            for type_ in topic.types
            if is_type_name(type_)
        }
        if self._with_services:
            yield from self._want_services(graph)
        for pair in self._versions.keys() - self._pairs.keys():
            if len(self._versions.pop(pair)) > 1:
                yield RemoveStatus(status_ids=(_versions_id(*pair),))
        yield from self._want_channels()
        for _, type_ in self._wanted_services:
            yield from self._describe(type_, service=True)
        yield from self._offer()

    def answer(
        self, answer: requests.Described | requests.ServiceFound | requests.Failed
    ) -> Iterator[ServerMessage | requests.HubRequest]:
        """What follows from the hub's answer about a type or a service."""
        handle = answer.handle
        if handle in self._searched:
            yield from self._service_found(self._searched.pop(handle), answer)
            return
        asked = self._asked[handle]
        if isinstance(answer, requests.Failed):
            asked.warned = True
            advice = f"; {answer.remedy}" if answer.remedy else ""
            what = "service" if asked.service else "topic"
            text = f"no {what} of type {asked.name} is shown: {answer.error}{advice}"
            yield FoxgloveStatus(level=StatusLevel.WARNING, message=text, id=_status_id(asked))
        elif isinstance(answer, requests.Described):
            asked.described = answer
            if asked.warned:
                asked.warned = False
                yield RemoveStatus(status_ids=(_status_id(asked),))
            yield from self._offer()

    def other_version(
        self, channel: Channel, md5sum: str, *, keep: bool
    ) -> Iterator[ServerMessage | requests.HubRequest]:
        """A message for a channel has another version of the type than its schema; it must not be sent there.

        Args:
            channel: The channel.
            md5sum: Of the message's version, which gets a channel of its own.
            keep: Whether messages of the channel's own version have come, too; else it is withdrawn.
        """
        pair = channel.topic, channel.schema_name
        versions = self._versions.setdefault(pair, {})
        if md5sum in versions or len(versions) >= limits.SEEN_TYPES_MAX:
            return
        if not versions and keep:
            own = self.md5sums[channel.id]
            versions[own] = None
            self._by_key[*pair, own] = self._by_key.pop((*pair, ""))
        versions[md5sum] = None
        if len(versions) > 1:
            text = (
                f"publishers of {channel.topic} have {len(versions)} versions of {channel.schema_name} (md5 sums "
                f"{', '.join(versions)}): each has a channel of its own; build all modules with one version"
            )
            yield FoxgloveStatus(level=StatusLevel.WARNING, message=text, id=_versions_id(*pair))
        yield from self._want_channels()
        yield from self._offer()

    # --- inside -----------------------------------------------------------------------------------------------

    def _want_channels(self) -> Iterator[ServerMessage | requests.HubRequest]:
        """A channel for each version that was seen of a topic's type; before that one, of the version known here."""
        self._wanted = {(*pair, md5sum): None for pair in self._pairs for md5sum in self._versions.get(pair) or ("",)}
        yield from self._forget_types()
        for _, type_, md5sum in self._wanted:
            yield from self._describe(type_, service=False, md5sum=md5sum)

    def _want_services(self, graph: GraphChanged) -> Iterator[requests.HubRequest]:
        present = {service.name for service in graph.services}
        self._found = {name: type_ for name, type_ in self._found.items() if name in present}
        self._wanted_services = {}
        for service in graph.services:
            type_ = service.type or self._found.get(service.name)
            if type_ and is_type_name(type_):
                self._wanted_services[service.name, type_] = None
            elif type_ is None or service.name not in self._found:
                self._found[service.name] = ""
                handle = self._next_handle()
                self._searched[handle] = service.name
                yield requests.FindService(handle, service.name)

    def _service_found(
        self, name: str, answer: requests.Described | requests.ServiceFound | requests.Failed
    ) -> Iterator[ServerMessage | requests.HubRequest]:
        if isinstance(answer, requests.ServiceFound) and name in self._found and is_type_name(answer.type):
            self._found[name] = answer.type
            self._wanted_services[name, answer.type] = None
            yield from self._describe(answer.type, service=True)
            yield from self._offer()

    def _forget_types(self) -> Iterator[ServerMessage]:
        wanted = {(type_, False, md5sum) for _, type_, md5sum in self._wanted}
        wanted |= {(type_, True, "") for _, type_ in self._wanted_services}
        for key in self._types.keys() - wanted:
            asked = self._types.pop(key)
            del self._asked[asked.handle]
            if asked.warned:
                yield RemoveStatus(status_ids=(_status_id(asked),))

    def _describe(self, name: str, *, service: bool, md5sum: str = "") -> Iterator[requests.HubRequest]:
        if (name, service, md5sum) not in self._types:
            handle = self._next_handle()
            self._types[name, service, md5sum] = self._asked[handle] = _Type(handle, name, service, md5sum)
            yield requests.DescribeType(handle, name, service, md5sum)

    def _offer(self) -> Iterator[ServerMessage]:
        gone = [key for key in self._by_key if key not in self._wanted]
        if gone:
            ids = tuple(self._by_key.pop(key).id for key in gone)
            for each in ids:
                del self.channels[each], self.md5sums[each]
            yield FoxgloveUnadvertise(channel_ids=ids)
        new: list[Channel] = []
        for key in self._wanted:
            if key not in self._by_key and (channel := self._channel(*key)):
                self._by_key[key] = self.channels[channel.id] = channel
                new.append(channel)
        yield from (FoxgloveAdvertise(channels=part) for part in _parts(new, lambda channel: len(channel.schema)))
        yield from self._offer_services()

    def _offer_services(self) -> Iterator[ServerMessage]:
        gone = [key for key in self._services_by_key if key not in self._wanted_services]
        if gone:
            ids = tuple(self._services_by_key.pop(key).id for key in gone)
            for each in ids:
                del self.services[each]
            yield FoxgloveUnadvertiseServices(service_ids=ids)
        missing = (key for key in self._wanted_services if key not in self._services_by_key)
        new = [service for key in missing if (service := self._service(*key))]
        for service in new:
            self._services_by_key[service.name, service.type] = self.services[service.id] = service
        sized = _parts(new, lambda service: len(service.request.schema) + len(service.response.schema))
        yield from (FoxgloveAdvertiseServices(services=part) for part in sized)

    def _channel(self, topic: str, type_: str, md5sum: str) -> Channel | None:
        described = self._types[type_, False, md5sum].described
        if described is None:
            return None
        number = next(self._channel_ids)
        self.md5sums[number] = md5sum or described.md5sum
        return Channel(
            id=number,
            topic=topic,
            encoding=ENCODING,
            schema_name=type_,
            schema_encoding=SCHEMA_ENCODING,
            schema=schema_text(described.text),
        )

    def _service(self, name: str, type_: str) -> FoxgloveService | None:
        described = self._types[type_, True, ""].described
        if described is None:
            return None
        request, response = (
            ServiceSchema(
                encoding=ENCODING,
                schema_name=f"{type_}{half}",
                schema_encoding=SCHEMA_ENCODING,
                schema=schema_text(text),
            )
            for half, text in (("Request", described.text), ("Response", described.response))
        )
        return FoxgloveService(id=next(self._service_ids), name=name, type=type_, request=request, response=response)


def schema_text(definition: str) -> str:
    """A definition as a schema: without a separator line at its beginning, which parsers of ``ros1msg`` refuse."""
    return definition.removeprefix(_SEPARATOR).removeprefix("\n") if definition.startswith("=") else definition


def _status_id(asked: _Type) -> str:
    version = f" {asked.md5sum}" if asked.md5sum else ""
    return f"{'service' if asked.service else 'message'} type {asked.name}{version}"


def _versions_id(topic: str, type_: str) -> str:
    return f"versions of {type_} on {topic}"


def _parts(items: Iterable[_T], size: Callable[[_T], int]) -> Iterator[tuple[_T, ...]]:
    part: list[_T] = []
    total = 0
    for item in items:
        more = size(item)
        if part and total + more > limits.FOXGLOVE_ADVERTISE_BYTES:
            yield tuple(part)
            part, total = [], 0
        part.append(item)
        total += more
    if part:
        yield tuple(part)


# Parameters between ROS and the Foxglove WebSocket protocol: their values, and a client's requests about them.
#
# ROS tells integers from floating-point numbers and has byte strings; JSON does neither, so a type goes with them.


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
