"""The examples of resources in TOML against the real nodes: each fits its node, starts it, adapts it, and ends it.

Those of images need OpenCV, 230 MB: ``scripts/install-ros --images``.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any, Final

import pytest
from click.testing import CliRunner

from rmpa.cli.main import cli
from rmpa.cli.run import load
from rmpa.resource.client import ResourceClient
from rmpa.resource.node import ResourceNode
from rmpa.resource.quality import QoSRequest, at_least
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node
from tests.interop.ros import Ros
from tests.waiting import until

pytestmark = [pytest.mark.ros, pytest.mark.timeout(180)]

FILES: Final = Path(__file__).parents[2] / "examples/resources"
LONG: Final = pytest.mark.long
URDF: Final = """<robot name="arm"><link name="base"/><link name="tip"/><joint name="elbow" type="continuous">
<parent link="base"/><child link="tip"/><axis xyz="0 0 1"/></joint></robot>"""


LACKS_OPENCV: Final = not Path("/usr/share/image_publisher/nodelet_plugins.xml").exists()


def example(
    name: str, package: str, others: tuple[str, ...], asked: dict[str, QoSRequest], first: str, then: str
) -> Any:
    """An example, its package, what must run beside it, what is asked, and the profiles before and after that."""
    small = package in ("diagnostic_updater", "robot_state_publisher")
    there = Path("/usr/lib", package).is_dir() or Path("/usr/lib/python3/dist-packages", package).is_dir()
    option = "" if small else " --images"
    missing = pytest.mark.skipif(
        not there or (LACKS_OPENCV and not small),
        reason=f"no {package} here (scripts/install-ros{option} installs it)",
    )
    return pytest.param(name, others, asked, first, then, id=name, marks=[missing] if small else [missing, LONG])


@asynccontextmanager
async def running(core: RosCore, *names: str) -> AsyncIterator[dict[str, ResourceNode]]:
    """The resources of examples, as ``rmpa run`` has them."""
    async with AsyncExitStack() as stack:
        found = {}
        for name in names:
            (resource,) = load(FILES / f"{name}.resource.toml")
            one = found[name] = ResourceNode(resource, core.uri)
            stack.push_async_callback(one.close)
            await one.learn()
            await one.start()
            await until(lambda one=one: one.adapter.adaptation.profile)  # type: ignore[misc]
        yield found


async def command(*words: str) -> tuple[int, str]:
    """Run ``rmpa`` in a thread."""
    done = await asyncio.to_thread(CliRunner().invoke, cli, words)
    return done.exit_code, done.output


async def nodes_of(core: RosCore) -> set[str]:
    async with Node("asker", master_uri=core.uri) as asker:
        state: Any = await asker.call_master("getSystemState")
    return {str(node) for table in state for _, nodes in table for node in nodes}


FAST: Final = {"rate": at_least("20 Hz", hard=True)}
CAMERA: Final = ("camera",)


@pytest.mark.parametrize(
    ("name", "others", "asked", "first", "then"),
    [
        example("heating", "diagnostic_updater", (), {"warmth": at_least("60 degC")}, "keep", "boost"),
        example("arm_state", "robot_state_publisher", (), FAST, "slow", "fast"),
        example("camera", "image_publisher", (), FAST, "small", "full"),
        example("picture", "nodelet", (), FAST, "slow", "fast"),
        example("colour", "image_proc", CAMERA, {"edges": at_least(2, hard=True)}, "bilinear", "vng"),
        example("preview", "image_transport", CAMERA, {"rate": at_least("3 Hz", hard=True)}, "off", "on"),
    ],
)
async def test_an_example_fits_its_node_and_adapts_it(
    core: RosCore, ros: Ros, name: str, others: tuple[str, ...], asked: dict[str, QoSRequest], first: str, then: str
) -> None:
    async with Node("guest", master_uri=core.uri) as guest:
        await guest.set_param("/robot_description", URDF)
        if name == "arm_state":
            ros.rospy("joints")
        async with running(core, *others, name) as resources:
            loop = resources[name].adapter.adaptation
            assert loop.profile == first
            path = FILES / f"{name}.resource.toml"

            async def fits() -> tuple[int, str]:
                return await command("resource", "check", str(path), "--master", core.uri, "--seconds", "1")

            code, said = await fits()
            assert code == 0, said
            async with ResourceClient(guest, name) as client:
                await client.require(**asked)  # type: ignore[arg-type] # by attribute
                await until(lambda: loop.profile == then)
                async with asyncio.timeout(40):
                    async for answer in client.answers():
                        if answer.level == 0:
                            break  # measured, and met
            code, said = await fits()
            assert (code, " 0 warnings" in said or "it fits" in said) == (0, True), said
            started = {node.name for node in resources[name].resource.nodes.values()}
            await until(lambda: loop.profile == first)
    assert not started & await nodes_of(core)
