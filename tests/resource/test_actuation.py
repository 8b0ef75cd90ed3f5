from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from rmpa.core.errors import PeerRefused
from rmpa.resource.actuation import same
from rmpa.resource.description import read_description
from rmpa.resource.node import ResourceNode
from rmpa.resource.resource import Resource
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node
from tests.resource.driver import driver, refuse
from tests.resource.rig import listen
from tests.waiting import until

CAMERA = """
role = "sensing"
[node.cam]
[parameter.fps]
dynamic = "frame_rate"
default = 15
low = 1
high = 60
[parameter.gain]
dynamic = "gain"
default = 1.0
[profile.full]
set = { fps = 30 }
offers = { sharpness = 2 }
cost = 2
[profile.small]
set = { fps = 10 }
offers = { sharpness = 1 }
[attribute.sharpness]
better = "max"
[adaptation]
window = "100 ms"
apply_timeout = "1 s"
cool_down = "30 s"
"""


def camera(text: str = CAMERA) -> Resource:
    return read_description(text.encode(), Path("camera.resource.toml"))


@asynccontextmanager
async def running(core: RosCore, resource: Resource, state: Path | None = None) -> AsyncIterator[ResourceNode]:
    one = ResourceNode(resource, core.uri, state=state)
    await one.start()
    try:
        yield one
    finally:
        await one.close()


def decision(one: ResourceNode) -> dict[str, Any]:
    said: dict[str, Any] = json.loads(json.dumps(one.adapter.decision(), default=str))
    return said


async def choose(one: ResourceNode, **values: Any) -> None:
    await one.configuration.set(values)


@pytest.mark.parametrize(
    ("one", "other", "equal"),
    [
        (30, 30.0, True),
        (0.1, 0.1 + 1e-9, True),
        (0.0, 1e-3, False),
        ("a", "a", True),
        (True, 1, True),
        (None, 0, False),
    ],
)
def test_numbers_are_the_same_within_a_tolerance(one: object, other: object, equal: bool) -> None:
    assert same(one, other) is equal


async def test_a_value_that_the_node_clips_is_undone_and_the_next_profile_taken(core: RosCore) -> None:
    resource = camera()
    async with driver(core, frame_rate=25.0, gain=1.0) as cam, running(core, resource) as one:
        cam.accept = lambda asked: {name: min(value, 20.0) for name, value in asked.items()}
        with pytest.raises(Exception, match=r"fps: wanted 30, got 20\.0"):
            await choose(one, profile="full")
        assert cam.values["frame_rate"] == 10.0
        assert one.adapter.adaptation.profile == "small"
        failed = next(each for each in decision(one)["history"] if "failed" in each)
        assert failed["failed"] == "node /cam refused: fps: wanted 30, got 20.0"


@pytest.mark.parametrize("how", ["refuses", "hangs", "is gone", "lacks it"])
async def test_all_nodes_get_their_values_or_none(core: RosCore, how: str) -> None:
    text = CAMERA.replace(
        "[node.cam]", '[node.cam]\n[node.laser]\n[parameter.power]\nnode = "laser"\ndynamic = "power"\ndefault = 1'
    ).replace("fps = 30", "fps = 30, power = 9")
    text = text.replace('dynamic = "frame_rate"', 'node = "cam"\ndynamic = "frame_rate"')
    text = text.replace('dynamic = "gain"', 'node = "cam"\ndynamic = "gain"')
    async with AsyncExitStack() as stack:
        laser = await stack.enter_async_context(driver(core, "laser", **{"pow" if how == "lacks it" else "power": 1}))
        cam = await stack.enter_async_context(driver(core, frame_rate=25.0, gain=1.0))
        one = await stack.enter_async_context(running(core, camera(text)))
        if how == "refuses":
            laser.accept = refuse
        elif how == "hangs":
            laser.answers.clear()
        elif how == "is gone":
            await laser.node.close()
        why = {
            "refuses": "node /laser refused: power = 9: no such mode",
            "hangs": "node /laser refused: power = 9: no answer within 1 s",
            "is gone": "node /laser (refused: it |refused: no parameter_updates|does not run)",
            "lacks it": "node /laser refused: power: it has no dynamic parameter power; did you mean pow",
        }[how]
        with pytest.raises(Exception, match=why):
            await choose(one, profile="full")
        laser.answers.set()
        assert cam.values["frame_rate"] == 10.0
        assert how == "is gone" or cam.calls[-2:] == [{"frame_rate": 30.0}, {"frame_rate": 10.0}]
        assert one.adapter.adaptation.profile == ("" if how == "is gone" else "small")


async def test_a_knob_that_is_turned_at_the_node_stays(core: RosCore, tmp_path: Path) -> None:
    resource, state = camera(), tmp_path / "camera.json"
    async with driver(core, frame_rate=25.0, gain=1.0) as cam:
        async with running(core, resource, state) as one:
            cam.turn(frame_rate=17.0)
            await until(lambda: decision(one)["by_hand"] == {"fps": 17})
            assert resource.parameters["fps"].value == 17
            await choose(one, profile="full", gain=2.0)  # as a tool that sends all does
            assert cam.values == {"frame_rate": 17.0, "gain": 2.0}
            cam.turn(frame_rate=30.0)  # what the profile wants
            await until(lambda: decision(one)["by_hand"] == {"gain": 2.0})
            cam.turn(frame_rate=12.0)
            await until(lambda: decision(one)["by_hand"] == {"gain": 2.0, "fps": 12})
        cam.turn(frame_rate=25.0)  # while it does not run
        async with running(core, camera(), state) as one:
            assert decision(one)["by_hand"] == {"gain": 2.0, "fps": 12}
            assert cam.values["frame_rate"] == 12.0
            await choose(one, profile="full")  # by hand, though it runs: gives it back
            assert cam.values["frame_rate"] == 30.0
            assert decision(one)["by_hand"] == {}
            cam.turn(frame_rate=12.0)
            await until(lambda: decision(one)["by_hand"] == {"fps": 12})
            await choose(one, profile="")
            await one.adapter.settled()
            assert (cam.values["frame_rate"], decision(one)["by_hand"]) == (10.0, {})


async def test_a_value_by_hand_that_the_node_refuses_now_bars_no_profile(core: RosCore, tmp_path: Path) -> None:
    state = tmp_path / "camera.json"
    async with driver(core, frame_rate=25.0, gain=1.0) as cam:
        async with running(core, camera(), state) as one:
            await choose(one, fps=50)
        cam.turn(frame_rate=25.0)
        cam.accept = lambda asked: {name: min(value, 20.0) for name, value in asked.items()}
        async with running(core, camera(), state) as one:
            assert (one.adapter.adaptation.profile, decision(one)["by_hand"]) == ("small", {})
            assert cam.values["frame_rate"] == 10.0


async def test_parameters_of_the_resource_are_set_at_the_node(core: RosCore, node: Node) -> None:
    resource = camera()
    async with driver(core, frame_rate=25.0, gain=1.0) as cam, running(core, resource) as one:
        updates = await listen(node, "/camera/parameter_updates", "dynamic_reconfigure/Config")
        await choose(one, fps=20)
        assert cam.values["frame_rate"] == 20.0
        await until(lambda: updates and [each.value for each in updates[-1].ints] == [20])
        cam.accept = refuse
        with pytest.raises(PeerRefused, match=r"gain = 3\.0: no such mode"):
            await choose(one, gain=3.0)
        assert resource.parameters["gain"].value == 1.0
        cam.accept = lambda asked: asked
        resource.parameters["gain"].value = 4.0  # the user's code
        await until(lambda: cam.values["gain"] == 4.0)


async def test_a_node_that_was_started_anew_gets_the_values_again(core: RosCore) -> None:
    async with AsyncExitStack() as stack:
        first = await stack.enter_async_context(driver(core, frame_rate=25.0, gain=1.0))
        await stack.enter_async_context(running(core, camera()))
        assert first.values["frame_rate"] == 10.0
        await first.node.close()
        again = await stack.enter_async_context(driver(core, frame_rate=25.0, gain=3.0))
        await until(lambda: again.values == {"frame_rate": 10.0, "gain": 3.0})


class Restarts:
    """Stands in for what starts nodes."""

    def __init__(self) -> None:
        self.done: list[Any] = []
        self.up = {"cam"}
        self.bad = ""

    async def start(self) -> None: ...

    async def require(self, keys: Any) -> None:
        self.done.append(sorted(keys))
        self.up |= set(keys)

    async def restart(self, key: str, *, args: Any = {}) -> None:  # noqa: B006
        self.done.append((key, dict(args)))
        if self.bad and self.bad in args.values():
            raise PeerRefused("node /cam", "it has ended with code 1")

    def pid(self, key: str) -> int | None:
        return 7 if key in self.up else None


async def test_private_parameters_and_arguments_restart_the_node(core: RosCore, node: Node) -> None:
    text = """
    role = "sensing"
    [node.cam]
    launch = "some cam.launch"
    args = ["mode:=slow"]
    [parameter.mode]
    arg = "mode"
    default = "slow"
    [parameter.size]
    private = "size"
    default = 1
    [parameter.live]
    private = "live"
    restart = false
    default = 0.5
    [profile.full]
    set = { mode = "fast", size = 2, live = 2.5 }
    offers = {}
    [profile.small]
    set = { mode = "slow", size = 2 }
    offers = {}
    """
    resource = camera(text)
    one = ResourceNode(resource, core.uri)
    stand_in: Any = Restarts()
    one.actuation._processes = stand_in
    await one.start()
    try:
        await choose(one, profile="small")
        await choose(one, live=7.0)
        assert await node.get_param("/cam/live") == 7.0
        assert stand_in.done == [[], ("cam", {"mode": "fast"}), [], ("cam", {"mode": "slow"})][: len(stand_in.done)]
        assert (await node.get_param("/cam/size"), len(stand_in.done)) == (2, 4)
        stand_in.bad = "fast"
        with pytest.raises(Exception, match="it has ended with code 1"):
            await choose(one, profile="full")
        assert stand_in.done[5:7] == [("cam", {"mode": "fast"}), ("cam", {"mode": "slow"})]  # and undone
        await node.set_param("/cam/live", 9.0)  # as rosparam does
        await until(lambda: decision(one)["by_hand"] == {"live": 9.0})
    finally:
        await one.close()


async def test_three_nodes_are_set_at_the_same_time(core: RosCore) -> None:
    nodes = ("one", "two", "three")
    tables = "".join(
        f'[node.{key}]\n[parameter.p_{key}]\nnode = "{key}"\ndynamic = "p"\ndefault = 0\n' for key in nodes
    )
    sets = ", ".join(f"p_{key} = 5" for key in nodes)
    text = (
        f'role = "sensing"\n{tables}[profile.idle]\noffers = {{}}\n[profile.busy]\nset = {{ {sets} }}\noffers = {{}}'
    )
    async with AsyncExitStack() as stack:
        made = [await stack.enter_async_context(driver(core, key, p=0)) for key in nodes]
        one = await stack.enter_async_context(running(core, camera(text)))
        for each in made:
            each.answers.clear()
        change = asyncio.create_task(choose(one, profile="busy"))
        await until(lambda: all(each.calls for each in made), "one waits for the other")
        for each in made:
            each.answers.set()
        await change
        assert [each.values["p"] for each in made] == [5, 5, 5]
