"""What waits for endpoints and for ROS 2's graph, and what takes messages, whichever release of rclpy is there.

An older branch is made to look like a later one, for which the half is written. From Humble on an entity has a handle
with methods, and there is a class of wait sets; Foxy has functions of capsules.
"""

from __future__ import annotations

import ctypes
import os
import time
from functools import partial
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    from collections.abc import Iterable

# The distributions by the first release of rclpy that is of a later one.
_RCLPY_BELOW = (("foxy", 2), ("humble", 4), ("iron", 5), ("jazzy", 8), ("kilted", 10))
# The words of wait sets for the kinds of endpoints that are waited for, in the order in which they are handled.
_WORDS = {"MS": "subscription", "SC": "client", "SS": "service"}
# Bytes of a GUID of DDS that its participant has (DDSI-RTPS 9.3.1).
_PARTICIPANT = 12
# Bytes from which on a message is not copied.
_LARGE = 65536
# The fields of rcutils_allocator_t, pointers all.
_ALLOCATOR = ("allocate", "deallocate", "reallocate", "zero_allocate", "state")


class FoxyHandle:
    """What a handle of later branches has, of those methods that the half calls."""

    _FUNCTIONS: ClassVar = {
        "take_message": "take",
        "send_request": "send_request",
        "service_send_response": "send_response",
    }

    def __init__(self, native: Any, handle: Any) -> None:
        self._native = native
        self.of = handle
        self.pointer = handle.pointer

    def __getattr__(self, name: str) -> Any:
        return partial(self._call, self._FUNCTIONS.get(name, name))

    def _call(self, function: str, *args: Any) -> Any:
        with self.of as capsule:
            return getattr(self._native, "rclpy_" + function)(capsule, *args)

    def take_response(self, kind: Any) -> Any:
        """The header, which has the request's number, and the response."""
        header, response = self._call("take_response", kind)
        if header is None:
            return None, None
        number = self._native.rclpy_service_info_get_sequence_number(header)
        return SimpleNamespace(sequence_number=number), response

    def service_take_request(self, kind: Any) -> Any:
        """The request and its header."""
        return self._call("take_request", kind) or (None, None)


class FoxyWaitSet:
    """What the class of wait sets of later branches has."""

    def __init__(self, native: Any, counts: tuple[int, ...], context: Any) -> None:
        self._native = native
        self.capsule = native.rclpy_get_zero_initialized_wait_set()
        with context as capsule:
            native.rclpy_wait_set_init(self.capsule, *counts, capsule)

    def __del__(self) -> None:
        self._native.rclpy_destroy_wait_set(self.capsule)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("add_"):
            return partial(self._add, name[len("add_") :])
        return partial(
            getattr(self._native, {"wait": "rclpy_wait"}.get(name, "rclpy_wait_set_" + name)), self.capsule
        )

    def _add(self, kind: str, handle: Any) -> None:
        with handle.of as capsule:
            self._native.rclpy_wait_set_add_entity(kind, self.capsule, capsule)

    def get_ready_entities(self, kind: str) -> Any:
        """The pointers of those that are ready."""
        return self._native.rclpy_get_ready_entities(kind, self.capsule)


def handle_of(native: Any, entity: Any) -> Any:
    """The handle of an entity, with methods."""
    return entity.handle if hasattr(native, "WaitSet") else FoxyHandle(native, entity.handle)


def make_wait_set(native: Any, counts: tuple[int, ...], context: Any) -> Any:
    """A wait set for so many subscriptions, guard conditions, timers, clients, services and events."""
    if hasattr(native, "WaitSet"):
        return native.WaitSet(*counts, context.handle)
    return FoxyWaitSet(native, counts, context.handle)


def event_callbacks(publishes: bool, incompatible: Any) -> Any:
    """The argument ``event_callbacks`` by which an endpoint tells of a QoS that fits no other one."""
    try:
        from rclpy import event_handler as events
    except ImportError:  # before Iron
        from rclpy import qos_event as events
    made = events.PublisherEventCallbacks if publishes else events.SubscriptionEventCallbacks
    return made(incompatible_qos=incompatible, use_default_callbacks=False)


def look_at_events(native: Any, context: Any, entities: list[Any]) -> None:
    """Call back for what has happened to them."""
    handlers = [handler for entity in entities for handler in getattr(entity, "event_handlers", ())]
    if handlers:
        wait_set = make_wait_set(native, (0, 0, 0, 0, 0, len(handlers)), context)
        wait_set.clear_entities()
        of_events = getattr(wait_set, "capsule", wait_set)
        for handler in handlers:
            handler.add_to_wait_set(of_events)
        wait_set.wait(0)
        for handler in handlers:
            if handler.is_ready(of_events):
                handler.callback(handler.take_data())


def distribution() -> str:
    """The distribution of ROS 2, by its variable or the release of rclpy."""
    named = os.environ.get("ROS_DISTRO", "").lower()
    if named:
        return named
    try:
        from importlib.metadata import version

        release = [int(part) for part in version("rclpy").split(".")[:2]]
    except Exception:
        return ""
    return next((name for name, below in _RCLPY_BELOW if release[0] < below), "")


class _ByteArray(ctypes.Structure):
    """rcutils/types/uint8_array.h, with its allocator."""

    _fields_ = [
        ("buffer", ctypes.POINTER(ctypes.c_uint8)),
        ("length", ctypes.c_size_t),
        ("capacity", ctypes.c_size_t),
        *[(name, ctypes.c_void_p) for name in _ALLOCATOR],
    ]


def _message_info(gid_size: int, numbered: bool) -> Any:
    """rmw_message_info_t of rmw/types.h: Foxy has no numbers, and GIDs have 24 bytes before Iron."""
    numbers = [("sequence", ctypes.c_uint64), ("reception", ctypes.c_uint64)] if numbered else []
    fields = [
        ("source_stamp", ctypes.c_int64),
        ("received_stamp", ctypes.c_int64),
        *numbers,
        ("implementation", ctypes.c_char_p),
        ("gid", ctypes.c_uint8 * gid_size),
        ("from_intra_process", ctypes.c_bool),
        ("reserve", ctypes.c_uint8 * 64),
    ]
    return type("MessageInfo", (ctypes.Structure,), {"_fields_": fields})


class _Allocator(ctypes.Structure):
    """rcutils_allocator_t."""

    _fields_ = [(name, ctypes.c_void_p) for name in _ALLOCATOR]


class Taker:
    """Takes them one by one.

    From Kilted on rclpy has it. Before, rcl is called by ctypes, with the structure that the check at the start has
    found to be right. Where neither does it, ``gids`` is false.
    """

    def __init__(self) -> None:
        self.gids = False
        # Of DDS: the first bytes of the GIDs of all endpoints of this process.
        self.prefix = b""
        self._info: Any = None
        self._rcl: Any = None
        self._array: Any = None
        # The arguments of a take behind the subscription, and where it leaves the GID.
        self._into: tuple[int, int, None] = (0, 0, None)
        self._gid_at = self._gid_size = 0

    def check(self, node: Any, message_type: Any, qos: Any, handle_of: Any) -> None:
        """Publish to ourselves, and see which way gives the publisher's GID."""
        name = "/rmpa/_gid_check_%d" % os.getpid()
        subscription = node.create_subscription(message_type, name, ignore, qos, raw=True)
        publisher = node.create_publisher(message_type, name, qos)
        handle = handle_of(subscription)
        try:
            own = self._own_gid(node, name)
            for layout in (None, (16, True), (24, True), (24, False)):
                if layout is not None and not self._use(layout):
                    return
                for _ in range(20):
                    publisher.publish(b"\0\1\0\0\0\0\0\0")
                    time.sleep(0.02)
                    taken = self.take(handle, message_type)
                    if taken is not None:
                        self.gids = bool(own) and taken[1][: len(own)] == own
                        break
                if self.gids:
                    self.prefix = own[:_PARTICIPANT]
                    return
            self._info = None
        finally:
            node.destroy_publisher(publisher)
            node.destroy_subscription(subscription)

    @staticmethod
    def _own_gid(node: Any, name: str) -> bytes:
        for _ in range(50):
            for info in node.get_publishers_info_by_topic(name):
                return bytes(info.endpoint_gid)
            time.sleep(0.02)
        return b""

    def _use(self, layout: tuple[int, bool]) -> bool:
        try:
            # rclpy has loaded it; where wheels have it elsewhere the symbols are in the process.
            rcl = ctypes.CDLL(loaded("librcl.so"))
            self._rcl = rcl.rcl_take_serialized_message
        except (OSError, AttributeError):
            return False
        self._rcl.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
        kind = _message_info(*layout)
        self._info = kind()
        self._gid_at, self._gid_size = ctypes.addressof(self._info) + kind.gid.offset, layout[0]
        utils = ctypes.CDLL(loaded("librcutils.so"))
        utils.rcutils_get_default_allocator.restype = _Allocator
        allocator = utils.rcutils_get_default_allocator()
        self._array = _ByteArray()
        for field in _ALLOCATOR:
            setattr(self._array, field, getattr(allocator, field))
        self._into = ctypes.addressof(self._array), ctypes.addressof(self._info), None
        return True

    def take(self, handle: Any, message_type: Any) -> tuple[Any, bytes, int, int] | None:
        """The next message of a subscription with GID, source stamp (ns) and number; ``None``: there is none.

        The bytes of a large one hold until the next is taken.
        """
        if self._info is None:
            taken = handle.take_message(message_type, True)
            if taken is None:
                return None
            data, info = taken
            gid = info.get("publisher_gid") if isinstance(info, dict) else None
            number = info.get("publication_sequence_number") if isinstance(info, dict) else 0
            stamp = info["source_timestamp"] if isinstance(info, dict) else 0
            return data, _gid_bytes(gid), stamp, number or 0
        if self._rcl(handle.pointer, *self._into):
            return None
        info = self._info
        array, data = self._array, None
        if array.length < _LARGE:
            data = ctypes.string_at(array.buffer, array.length)
        else:
            data = (ctypes.c_uint8 * array.length).from_address(ctypes.addressof(array.buffer.contents))
        return data, ctypes.string_at(self._gid_at, self._gid_size), info.source_stamp, getattr(info, "sequence", 0)

    def is_own(self, gid: bytes) -> bool:
        """Whether a message is of a publisher of this process."""
        return self.gids and gid[:_PARTICIPANT] == self.prefix


def _gid_bytes(gid: Any) -> bytes:
    if gid is None:
        return b""
    return bytes(gid["data"] if isinstance(gid, dict) else gid)


def loaded(name: str) -> str:
    """The path of a library that this process has loaded: in wheels its name has a hash behind."""
    stem = name.split(".", maxsplit=1)[0]
    with open("/proc/self/maps") as maps:
        for line in maps:
            path = line.split(None, 5)[5].strip() if line.count("/") else ""
            base = os.path.basename(path)
            if base.startswith((stem + ".", stem + "-")):
                return path
    return name


def ignore(_message: Any) -> None:
    """Do nothing: the callback of what is taken by hand."""


class GraphGuard:
    """The guard condition of ROS 2's graph, which rclpy does not have: of rcl, by ctypes."""

    def __init__(self, node: Any) -> None:
        self.pointer = 0
        try:
            rcl = ctypes.CDLL(loaded("librcl.so"))
            of_node, self._add = rcl.rcl_node_get_graph_guard_condition, rcl.rcl_wait_set_add_guard_condition
            of_node.argtypes, of_node.restype = [ctypes.c_void_p], ctypes.c_void_p
            self._add.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
            self.pointer = of_node(node.handle.pointer) or 0
        except (OSError, AttributeError):
            pass  # the graph is polled

    def add(self, wait_set: Any) -> None:
        """Have a wait set wait for it too."""
        if self.pointer and hasattr(wait_set, "pointer") and self._add(wait_set.pointer, self.pointer, None):
            self.pointer = 0


class Waits:
    """A wait set for the endpoints that there are now.

    Args:
        native: rclpy's implementation.
        context: Of the endpoints.
        endpoints: They; publishers among them are left out.
        wake: A guard condition that ends the waiting.
        graph: That of the graph, or one that does not work.
    """

    def __init__(self, native: Any, context: Any, endpoints: Iterable[Any], wake: Any, graph: GraphGuard) -> None:
        by_kind: dict[str, list[Any]] = {kind: [] for kind in _WORDS}
        for endpoint in endpoints:
            by_kind.get(endpoint.kind, []).append(endpoint)
        counts = len(by_kind["MS"]), 2, 0, len(by_kind["SC"]), len(by_kind["SS"]), 0
        self._set = make_wait_set(native, counts, context)
        self._kinds = [
            (word, getattr(self._set, "add_" + word), [endpoint.handle for endpoint in by_kind[kind]])
            for kind, word in _WORDS.items()
            if by_kind[kind]
        ]
        self._by_pointer = {each.handle.pointer: each for endpoints in by_kind.values() for each in endpoints}
        self._wake = wake
        self._graph = graph
        self.graph_changed = False

    def wait(self, timeout: float) -> list[Any]:
        """Wait for so many seconds at the most; return the endpoints that have something."""
        wait_set = self._set
        wait_set.clear_entities()
        for _, add, handles in self._kinds:
            for handle in handles:
                add(handle)
        wait_set.add_guard_condition(self._wake)
        self._graph.add(wait_set)
        wait_set.wait(max(0, int(timeout * 1e9)))
        self.graph_changed = self._graph.pointer in wait_set.get_ready_entities("guard_condition")
        by_pointer, ready = self._by_pointer, wait_set.get_ready_entities
        return [by_pointer[pointer] for word, _, _ in self._kinds for pointer in ready(word)]
