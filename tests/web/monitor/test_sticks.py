"""Who has the stick: one page in the mesh, whichever server it is at, and whatever they hear of each other."""

from __future__ import annotations

import os
import random
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.web.hub.topics import ReceivedMessage
from rmpa.web.monitor import limits
from rmpa.web.monitor.driving import Stick, Sticks

TOPIC = "/cmd_vel"


class Bus:
    """The hubs of servers in one mesh: what one publishes reaches all, unless the test holds it back."""

    def __init__(self) -> None:
        self.receivers: list[tuple[str, Callable[[ReceivedMessage], None]]] = []
        self.held: list[Callable[[], None]] | None = None
        self.refuses: RmpaError | None = None
        self.topics: Any = self

    def subscribe(self, topic: str, _type: str, receive: Callable[[ReceivedMessage], None], _failed: Any) -> Any:
        entry = topic, receive
        self.receivers.append(entry)
        return SimpleNamespace(close=lambda: self.receivers.remove(entry))

    def advertise(self, topic: str, type_: str, _failed: Any, *, latch: bool) -> Any:
        assert latch
        if self.refuses is not None:
            raise self.refuses

        def publish(payload: bytes) -> None:
            message = ReceivedMessage(topic, type_, memoryview(payload), 0)
            for name, receive in [*self.receivers]:
                if name == topic:
                    if self.held is None:
                        receive(message)
                    else:
                        self.held.append(lambda receive=receive: receive(message))  # type: ignore[misc]

        return SimpleNamespace(publish=publish, close=lambda: None)


class Mesh:
    """Servers of some modules, each with a page that shows the joystick."""

    def __init__(self, *modules: str) -> None:
        self.now = 10.0
        self.bus = Bus()
        hub: Any = self.bus
        self.servers = {name: Sticks(hub, lambda name=name: name, lambda: self.now) for name in modules}  # type: ignore[misc]
        self.sticks = {name: self.show(name, name) for name in modules}

    def show(self, module: str, page: str) -> Stick:
        return self.servers[module].show(TOPIC, page, lambda _: None, drives=True)

    def after(self, seconds: float) -> None:
        end = self.now + seconds
        while self.now < end:
            self.now = min(end, self.now + 0.1)
            for name, stick in self.sticks.items():
                stick.handle_timer(name)

    def holders(self) -> list[str]:
        """What each server believes."""
        return [stick.hold.by for stick in self.sticks.values()]


def test_one_page_of_all_modules_has_it_and_a_second_one_sees_who() -> None:
    mesh = Mesh("base", "pc")
    base, pc = mesh.sticks.values()
    base.take("base", "10.0.0.1")
    assert (pc.hold.by, pc.hold.module, pc.holder) == ("10.0.0.1", "base", None)
    with pytest.raises(PeerRefused, match=r"the page of 10\.0\.0\.1 at base has it"):
        pc.take("pc", "10.0.0.2")
    other = mesh.show("base", "other page")
    with pytest.raises(PeerRefused):
        other.take("other page", "10.0.0.3")
    base.leave("other page")
    assert mesh.holders() == ["10.0.0.1"] * 2, "it lets go of what it does not have"
    base.leave("base")
    pc.take("pc", "10.0.0.2")
    assert mesh.holders() == ["10.0.0.2"] * 2


def test_a_late_word_of_an_earlier_hold_changes_nothing() -> None:
    mesh = Mesh("base", "pc")
    base, pc = mesh.sticks.values()
    mesh.bus.held = []
    base.take("base", "10.0.0.1")
    late = [*mesh.bus.held]
    mesh.bus.held = None
    for _ in range(2):
        pc.stop("10.0.0.2")
    pc.take("pc", "10.0.0.2")
    for word in late:
        word()
    assert (pc.holder, mesh.holders()) == ("pc", ["10.0.0.2"] * 2)


def test_it_is_free_some_time_after_the_holder_s_server_has_vanished() -> None:
    mesh = Mesh("base", "pc")
    mesh.sticks["base"].take("base", "10.0.0.1")
    mesh.after(10 * limits.STICK_EXPIRY)
    assert mesh.holders() == ["10.0.0.1"] * 2, "its server says it again and again"
    del mesh.sticks["base"]
    mesh.after(limits.STICK_EXPIRY - limits.STICK_RENEW - 0.2)
    assert mesh.holders() == ["10.0.0.1"]
    mesh.after(limits.STICK_RENEW + 0.4)
    assert mesh.holders() == [""]
    assert mesh.sticks["pc"].due("pc") is None


def test_a_newcomer_with_a_low_number_is_heard_where_it_is_free() -> None:
    mesh = Mesh("base", "pc")
    for _ in range(5):
        mesh.sticks["base"].take("base", "10.0.0.1")
        mesh.sticks["base"].leave("base")
    mesh.sticks["pc"].hide("pc")
    mesh.sticks["pc"] = mesh.show("pc", "pc")
    mesh.sticks["pc"].take("pc", "10.0.0.2")
    mesh.after(2 * limits.STICK_EXPIRY)
    assert mesh.holders() == ["10.0.0.2"] * 2


@pytest.mark.parametrize("seed", range(30))
def test_all_agree_on_one_holder_in_whatever_order_they_hear(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages take, take over, leave and stop while words are late; then all servers believe the same."""
    rng = random.Random(seed)
    monkeypatch.setattr(os, "urandom", rng.randbytes)
    mesh = Mesh("a", "b", "c")
    mesh.bus.held = []
    for _ in range(60):
        name = rng.choice([*mesh.sticks])
        stick, order = mesh.sticks[name], rng.choice(("take", "over", "leave", "stop", "wait", "hear", "hear"))
        if order in ("take", "over") and (order == "over" or not stick.hold.by):
            stick.take(name, name, over=order == "over")
        elif order == "leave":
            stick.leave(name)
        elif order == "stop":
            stick.stop(name)
        elif order == "wait":
            mesh.after(0.3)
        else:
            for _ in range(rng.randrange(len(mesh.bus.held) + 1)):
                mesh.bus.held.pop(rng.randrange(len(mesh.bus.held)))()
    for late in mesh.bus.held:
        late()
    mesh.bus.held = None
    mesh.after(3 * limits.STICK_EXPIRY)
    assert len(set(mesh.holders())) == 1
    held = [name for name, stick in mesh.sticks.items() if stick.holder == name]
    assert held == [name for name in mesh.holders()[:1] if name]


def test_a_mesh_whose_rules_forbid_it_has_it_within_one_server_and_says_so() -> None:
    mesh = Mesh()
    mesh.bus.refuses = RmpaError("no [[permission]] lets web publish /cmd_vel/holder")
    hub: Any = mesh.bus
    sticks = Sticks(hub, lambda: "pc", lambda: 0.0)
    stick = sticks.show(TOPIC, "one", lambda _: None, drives=True)
    stick.take("one", "10.0.0.1")
    assert "no [[permission]] lets web publish" in stick.problem
    with pytest.raises(PeerRefused):
        stick.take("two", "10.0.0.2")
    stick.hide("one")
    assert not mesh.bus.receivers, "nothing is left open"


def test_words_of_other_programs_are_nothing() -> None:
    mesh = Mesh("base")
    ((_, receive),) = mesh.bus.receivers
    for text in (b"", b"hello", b"\x05\0\0\0[1,2]", b'\x02\0\0\0{"turn":"x"}'):
        receive(ReceivedMessage(f"{TOPIC}/holder", "std_msgs/String", memoryview(text), 0))
    assert mesh.holders() == [""]
