"""The adapter of ROS 2's half for branches of rclpy, against stand-ins made from the API of foxy and humble."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest

from rmpa.gateway.ros2.half.branches import GraphGuard, Taker, Waits, handle_of, look_at_events


class Capsule(nullcontext[str]):
    """``rclpy.handle.Handle`` of Foxy: inside ``with`` it is what the functions take."""

    def __init__(self, name: str, pointer: int) -> None:
        super().__init__(name)
        self.pointer = pointer


class Foxy:
    """``_rclpy`` of Foxy: functions that take capsules."""

    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []
        self.answers: dict[str, Any] = {"rclpy_get_zero_initialized_wait_set": "wait set"}

    def __getattr__(self, name: str) -> Any:
        if not name.startswith("rclpy_"):
            raise AttributeError(name)

        def call(*args: Any) -> Any:
            self.calls.append((name[len("rclpy_") :], *args))
            return self.answers.get(name)

        return call


class HumbleWaitSet:
    """``_rclpy.WaitSet`` of Humble: all that was added is ready."""

    made: list[tuple[Any, ...]]

    def __init__(self, *counts: Any) -> None:
        type(self).made.append(counts)
        self.pointer = 1
        self.added: dict[str, list[Any]] = {}

    def clear_entities(self) -> None:
        self.added.clear()

    def __getattr__(self, name: str) -> Any:
        return lambda handle: self.added.setdefault(name[len("add_") :], []).append(handle)

    def wait(self, timeout: int) -> None:
        assert timeout >= 0

    def get_ready_entities(self, kind: str) -> list[int]:
        return [handle.pointer for handle in self.added.get(kind, ())]


@pytest.fixture
def humble() -> Any:
    HumbleWaitSet.made = []
    return SimpleNamespace(WaitSet=HumbleWaitSet)


def endpoint(native: Any, kind: str, pointer: int) -> Any:
    entity = SimpleNamespace(handle=Capsule(f"{kind} {pointer}", pointer))
    return SimpleNamespace(kind=kind, handle=handle_of(native, entity))


def guard() -> GraphGuard:
    made = GraphGuard(SimpleNamespace(handle=None))
    assert not made.pointer, "there is no rcl here: the graph is polled"
    return made


def test_a_wait_set_of_humble_waits_for_all_but_publishers(humble: Any) -> None:
    endpoints = [endpoint(humble, kind, number) for number, kind in enumerate(("MP", "SS", "MS", "SC", "MS"), 10)]
    waits = Waits(humble, SimpleNamespace(handle="context"), endpoints, Capsule("wake", 5), guard())
    assert HumbleWaitSet.made == [(2, 2, 0, 1, 1, 0, "context")]
    for _ in range(2):
        assert [(each.kind, each.handle.pointer) for each in waits.wait(0.1)] == [
            ("MS", 12), ("MS", 14), ("SC", 13), ("SS", 11),
        ]  # fmt: skip
    assert not waits.graph_changed


def test_a_wait_set_of_foxy_is_made_by_functions() -> None:
    foxy = Foxy()
    endpoints = [endpoint(foxy, "MS", 10), endpoint(foxy, "SS", 11)]
    foxy.answers["rclpy_get_ready_entities"] = [10]
    wake = handle_of(foxy, SimpleNamespace(handle=Capsule("wake", 5)))
    waits = Waits(foxy, SimpleNamespace(handle=Capsule("context", 1)), endpoints[:1], wake, guard())
    assert waits.wait(0.5) == endpoints[:1]
    assert foxy.calls == [
        ("get_zero_initialized_wait_set",), ("wait_set_init", "wait set", 1, 2, 0, 0, 0, 0, "context"),
        ("wait_set_clear_entities", "wait set"), ("wait_set_add_entity", "subscription", "wait set", "MS 10"),
        ("wait_set_add_entity", "guard_condition", "wait set", "wake"), ("wait", "wait set", 500_000_000),
        ("get_ready_entities", "guard_condition", "wait set"), ("get_ready_entities", "subscription", "wait set"),
    ]  # fmt: skip


def test_handles_of_foxy_take_and_send_by_functions() -> None:
    foxy = Foxy()
    handle = endpoint(foxy, "SC", 3).handle
    assert handle.pointer == 3
    foxy.answers |= {"rclpy_take_response": (None, None), "rclpy_send_request": 7}
    assert handle.take_response("T") == (None, None)
    assert handle.service_take_request("T") == (None, None)
    assert handle.send_request("request") == 7
    foxy.answers |= {
        "rclpy_take_response": ("header", "response"),
        "rclpy_service_info_get_sequence_number": 7,
        "rclpy_take_request": ["request", "header"],
    }
    header, response = handle.take_response("T")
    assert (header.sequence_number, response) == (7, "response")
    assert handle.service_take_request("T") == ["request", "header"]
    handle.service_send_response("response", "header")
    assert foxy.calls[-1] == ("send_response", "SC 3", "response", "header")


@pytest.mark.parametrize("info", [{"source_timestamp": 5, "received_timestamp": 6}, None])
def test_a_message_of_humble_and_foxy_has_no_gid(info: Any) -> None:
    """So echoes are known by what was sent and not yet heard."""
    foxy = Foxy()
    taker = Taker()
    handle = endpoint(foxy, "MS", 3).handle
    assert taker.take(handle, "T") is None
    foxy.answers["rclpy_take"] = (b"cdr", info)
    assert taker.take(handle, "T") == (b"cdr", b"", 5 if info else 0, 0)
    assert foxy.calls[-1] == ("take", "MS 3", "T", True)
    assert not taker.is_own(b"")


def test_events_of_foxy_have_its_wait_set() -> None:
    foxy = Foxy()
    told: list[str] = []

    class Handler:
        """``rclpy.qos_event.QoSEventHandler`` of Foxy."""

        callback = staticmethod(told.append)

        def add_to_wait_set(self, wait_set: Any) -> None:
            assert wait_set == "wait set"

        is_ready = staticmethod(lambda wait_set: wait_set == "wait set")
        take_data = staticmethod(lambda: "data")

    look_at_events(foxy, SimpleNamespace(handle=Capsule("context", 1)), [SimpleNamespace(event_handlers=[Handler()])])
    assert told == ["data"]
    assert foxy.calls[-1][0] in {"wait", "destroy_wait_set"}
