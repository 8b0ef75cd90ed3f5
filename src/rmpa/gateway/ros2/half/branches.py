"""What differs by branch of rclpy: an older one is made to look like a later one, for which the half is written.

From Humble on an entity has a handle with methods, and there is a class of wait sets; Foxy has functions of capsules.
"""

from __future__ import annotations

import os
from functools import partial
from types import SimpleNamespace
from typing import Any, ClassVar

# The distributions by the first release of rclpy that is of a later one.
_RCLPY_BELOW = (("foxy", 2), ("humble", 4), ("iron", 5), ("jazzy", 8), ("kilted", 10))


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
