"""The parameters of the local core, a copy that follows its changes, and the time in ROS."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
import math
import struct
import time
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final, cast

from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.ros.master.parameters import Parameters, leaves
from rmpa.runtime.tasks import end_tasks, keep_task
from rmpa.web import limits
from rmpa.web.hub.node_link import Follower, NodeLink, ParamValue

if TYPE_CHECKING:
    from rmpa.ros.node.node import Node
    from rmpa.ros.wire.xmlrpc import XmlRpcValue
    from rmpa.web.hub.topics import ClientSubscription, HubTopics, ReceivedMessage

_log = logging.getLogger(__name__)
# In the place of a value that is not there.
MISSING: Final = object()
CLOCK: Final = "/clock"
CLOCK_TYPE: Final = "rosgraph_msgs/Clock"
_PARAM: Final = "/use_sim_time"
_TIME: Final = struct.Struct("<II")
_NANO: Final = 1_000_000_000


class ParamMirror:
    """The copy, and the clients that follow it.

    Args:
        link: Has the node.
    """

    def __init__(self, link: NodeLink) -> None:
        self._link = link
        self._parameters = Parameters()
        self._followers: dict[Follower, tuple[tuple[str, ...], Callable[[Mapping[str, ParamValue]], None]]] = {}
        self._loading: asyncio.Task[None] | None = None
        self._meanwhile: list[tuple[str, XmlRpcValue]] | None = None
        self._told = 0
        # Set once the parameters are known.
        self.loaded = asyncio.Event()
        # How often they have changed.
        self.changes = 0
        link.on_node = self._load_from
        link.on_param_update = self.updated

    @property
    def tree(self) -> Mapping[str, ParamValue]:
        """All parameters; never changed afterwards."""
        return cast("Mapping[str, ParamValue]", self._parameters.tree)

    def value(self, name: str) -> ParamValue:
        """The value at a global name; ``None`` where there is none."""
        try:
            return cast("ParamValue", self._parameters.get(name))
        except KeyError:
            return None

    def values(self, names: tuple[str, ...] = ()) -> dict[str, ParamValue]:
        """The values of ``names`` that exist; without names those of all parameters."""
        if names:
            return {name: value for name in names if (value := self.value(name)) is not None}
        return dict(leaves("", self.value("/")))

    def updated(self, key: str, value: XmlRpcValue) -> None:
        """The master tells a change; ``{}`` for a parameter that was deleted."""
        self._told += 1
        if self._meanwhile is not None:
            self._meanwhile.append((key, value))
            return
        self._change(lambda: self._apply(key, value))

    async def set(self, name: str, value: ParamValue) -> None:
        """Set a parameter.

        Raises:
            RmpaError: The master does not answer, or refuses; or the rules deny it.
        """
        await self._check(name, value)
        told = self._told
        await self._link.need().set_param(name, cast("XmlRpcValue", value))
        # The master does not tell the node that set it.
        self._own_change(told, lambda: self._parameters.set(name, cast("XmlRpcValue", value)))

    async def delete(self, name: str) -> None:
        """Delete a parameter.

        Raises:
            RmpaError: The master does not answer, or the parameter does not exist; or the rules deny it.
        """
        await self._check(name)
        told = self._told
        await self._link.need().delete_param(name)
        self._own_change(told, lambda: self._remove(name))

    def follow(self, names: tuple[str, ...], changed: Callable[[Mapping[str, ParamValue]], None]) -> Follower:
        """Call ``changed`` with each change of ``names``, or of all; ``None`` is a parameter that was deleted."""
        return Follower(self._followers, (names, changed))

    def reload(self) -> None:
        """Read everything anew: the master was away."""
        if self._link.node is not None:
            self._load_from(self._link.node)

    async def close(self) -> None:
        """End the reading."""
        await end_tasks(self._loading)

    async def _check(self, name: str, after: ParamValue = None) -> None:
        """Check a change as ``NodeRules`` does, once no reading of the core's parameters is under way."""
        if self._link.rules.permissions is None:
            return
        self._link.need()
        await self.loaded.wait()
        while self._loading is not None and not self._loading.done():
            await asyncio.wait([self._loading])
        self._link.rules.check_param_change(name, self.value, after)

    def _own_change(self, told: int, apply: Callable[[], None]) -> None:
        """Apply a change that the master has taken, unless it told of others meanwhile: their order is not known."""
        self._change(apply)
        if told != self._told or self._meanwhile is not None:
            self.reload()

    def _load_from(self, node: Node) -> None:
        if self._loading is not None:
            self._loading.cancel()
        self._loading = keep_task(functools.partial(self._load, node), "read the parameters")

    async def _load(self, node: Node) -> None:
        while True:
            self._meanwhile = []
            try:
                tree = await node.follow_param("/")
                break
            except RmpaError as error:
                _log.debug("! the parameters cannot be read: %s", error)
                await asyncio.sleep(limits.NODE_RETRY)
        # Changes that the master told before its answer arrived are newer than the answer.
        meanwhile, self._meanwhile = self._meanwhile, None

        def apply() -> None:
            self._parameters.set("/", tree if isinstance(tree, dict) else {})
            for key, value in meanwhile:
                self._apply(key, value)

        self._change(apply)
        self.loaded.set()

    def _apply(self, key: str, value: XmlRpcValue) -> None:
        if value == {} and key.strip("/"):
            self._remove(key)
        else:
            try:
                self._parameters.set(key, value)
            except ValueError as error:
                _log.debug("! the master tells %s for %s: %s", type(value).__name__, key, error)

    def _remove(self, key: str) -> None:
        with contextlib.suppress(KeyError):
            self._parameters.delete(key)

    def _change(self, apply: Callable[[], None]) -> None:
        before = self._parameters.tree
        apply()
        after = self._parameters.tree
        if before is after:
            return
        self.changes += 1
        if not self._followers:
            return
        differences = dict(_differences("", before, after))
        for names, changed in [*self._followers.values()]:
            told = differences
            if names:
                news = {
                    name: new for name in names if not _same(value_at(before, name), new := value_at(after, name))
                }
                told = {name: None if new is MISSING else cast("ParamValue", new) for name, new in news.items()}
            if told:
                changed(told)


def as_json(value: object, binary: Callable[[bytes], str]) -> Any:
    """A parameter for JSON: what that lacks (NaN, infinities, dates) as text; bytes as ``binary`` makes of them."""
    if isinstance(value, Mapping):
        return {str(key): as_json(inner, binary) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(inner, binary) for inner in value]
    if isinstance(value, bytes | bytearray | memoryview):
        return binary(bytes(value))
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    return value if value is None or isinstance(value, bool | int | str) else str(value)


def _same(one: object, other: object) -> bool:
    """Whether two values are equal and of the same types: 1 is not 1.0, nor True."""
    if one is other:
        return True
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(_same(value, other[key]) for key, value in one.items())
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(_same, one, other))
    return type(one) is type(other) and one == other


def value_at(tree: object, name: str, missing: object = MISSING) -> object:
    """The value that a name has in a tree of parameters; ``missing`` where it has none."""
    for part in filter(None, name.split("/")):
        if not isinstance(tree, Mapping) or part not in tree:
            return missing
        tree = tree[part]
    return tree


def _differences(name: str, before: object, after: object) -> Iterator[tuple[str, ParamValue]]:
    """The leaves that differ, each with its new value; ``None`` for those that are gone."""
    if before is after or (not isinstance(after, Mapping) and _same(before, after)):
        return
    old = before if isinstance(before, Mapping) else {}
    new = after if isinstance(after, Mapping) else {}
    for key in old.keys() - new.keys():
        yield from ((leaf, None) for leaf, _ in leaves(f"{name}/{key}", old[key]))
    for key, value in new.items():
        yield from _differences(f"{name}/{key}", old.get(key, MISSING), value)
    if not isinstance(before, Mapping) and before is not MISSING and isinstance(after, Mapping):
        yield name, None
    if not isinstance(after, Mapping):
        yield name, cast("ParamValue", after)


class RosTime:
    """The present time.

    Args:
        topics: The hub's subscriptions.
        params: The parameters.
    """

    def __init__(self, topics: HubTopics, params: ParamMirror) -> None:
        self._topics = topics
        self._clock: ClientSubscription | None = None
        self._sim_ns = 0
        params.follow((_PARAM,), lambda values: self._use(bool(values.get(_PARAM))))

    @property
    def simulated(self) -> bool:
        """Whether ``/clock`` gives the time."""
        return self._clock is not None

    def now_ns(self) -> int:
        """Nanoseconds; 0 until the first message of ``/clock`` where that gives the time, as in rospy."""
        return self._sim_ns if self.simulated else time.time_ns()

    def _use(self, simulated: bool) -> None:
        if self._clock is not None and not simulated:
            self._clock.close()
            self._clock = None
        elif self._clock is None and simulated:
            self._sim_ns = 0
            with contextlib.suppress(PeerRefused):
                self._clock = self._topics.subscribe(CLOCK, CLOCK_TYPE, self._take)

    def _take(self, message: ReceivedMessage) -> None:
        self._sim_ns = clock_ns(message.payload) or self._sim_ns


def ros_time(now_ns: int) -> dict[str, int]:
    """A time of ROS, of nanoseconds."""
    seconds, nanoseconds = divmod(max(0, now_ns), _NANO)
    return {"secs": seconds, "nsecs": nanoseconds}


def clock_ns(payload: memoryview) -> int | None:
    """The time of a message of ``/clock`` in nanoseconds; ``None`` for another message."""
    if len(payload) != _TIME.size:
        return None
    seconds, nanoseconds = _TIME.unpack(payload)
    return int(seconds) * _NANO + int(nanoseconds)
