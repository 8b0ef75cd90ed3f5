from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from rmpa.resource import limits
from rmpa.resource.declare.requirements import at_least, at_most
from rmpa.resource.declare.resource import Resource
from rmpa.resource.run.client import ResourceClient
from rmpa.resource.run.resource_node import ResourceNode
from rmpa.resource.run.runtime import RuntimePart
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from rmpa.resource.decide.adaptation import CoolDown


@pytest.fixture
async def core() -> AsyncIterator[RosCore]:
    one = RosCore(port=0)
    await one.start()
    yield one
    await one.close()


def sonar(**more: Any) -> Resource:
    one = Resource("sonar", role="sensing")
    one.output("words", "std_msgs/String")
    one.attribute("noise", better="min", unit="m")
    one.parameter("gain", 1.0, low=0.0, high=10.0, **more)
    for name, noise, cost in (("fine", 0.01, 3), ("coarse", 0.1, 1)):
        one.profile(offers={"noise": noise}, cost=cost, name=name)(lambda: None)
    one.context("docked")
    one.adaptation(window="100 ms")
    return one


async def started(core: RosCore, path: Path, resource: Resource | None = None) -> ResourceNode:
    member = ResourceNode(resource or sonar(), core.uri, state=path)
    await member.start()
    return member


def cooling(member: ResourceNode) -> list[CoolDown]:
    return list(member.adapter.loop.cooling(asyncio.get_running_loop().time()).values())


async def until(fits: Any) -> None:
    async with asyncio.timeout(30):
        while not fits():
            await asyncio.sleep(0.01)


async def test_configuration_survives_a_restart(core: RosCore, tmp_path: Path) -> None:
    path = tmp_path / "sonar.json"
    first = await started(core, path)
    await first.configuration.set({"gain": 2.5, "profile": "fine", "context": "docked"})
    await first.close()
    other = RosCore(port=0)  # the module's whole agent was restarted: its parameter server knows nothing
    await other.start()
    again = await started(other, path)
    assert again.resource.parameters["gain"].value == 2.5
    assert (again.adapter.loop.pinned, again.contexts.current) == ("fine", "docked")
    await until(lambda: again.adapter.loop.profile == "fine")
    await again.configuration.set({"profile": "", "gain": 1.0, "context": ""})
    await again.close()
    third = await started(other, path)
    assert third.resource.parameters["gain"].value == 1.0
    assert (third.adapter.loop.pinned, third.contexts.current) == ("", "")
    await third.close()
    given = sonar()
    given.parameters["gain"].value = 7.0  # as rmpa run --set does
    given.parameters["gain"].given = True
    await other.close()
    fourth = await started(core, path, given)
    assert given.parameters["gain"].value == 7.0
    await fourth.close()


async def test_requirements_survive_a_restart(core: RosCore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "sonar.json"
    first = await started(core, path)
    async with Node("stays", master_uri=core.uri) as stays, ResourceClient(stays, "sonar") as one:
        async with Node("leaves", master_uri=core.uri) as leaves, ResourceClient(leaves, "sonar") as two:
            await one.require(noise=at_most("5 cm"), expires="60 s")
            await two.require(rate=at_least("1 Hz"), priority=3)
            before = first.adapter.loop.requirements["/stays"].expires
            await first.close()
        monkeypatch.setattr(limits, "RESOURCE_CLIENT_GRACE", 3.0)
        again = await started(core, path)
        began, loop = asyncio.get_running_loop().time(), again.adapter.loop
        assert loop.requirements.keys() == {"/stays", "/leaves"}
        assert loop.requirements["/leaves"].priority == 3
        await until(lambda: "/leaves" not in loop.requirements)
        assert 2.5 < asyncio.get_running_loop().time() - began < 20
        # The latched request came again meanwhile, and did not begin anew with its 60 s.
        assert before is not None
        assert loop.requirements["/stays"].expires == pytest.approx(before, abs=0.05)
        await again.close()


async def test_expired_latched_request_stays_expired(core: RosCore, tmp_path: Path) -> None:
    member = await started(core, tmp_path / "sonar.json")
    async with Node("client", master_uri=core.uri) as node, ResourceClient(node, "sonar") as client:
        await client.require(noise=at_most("5 cm"), expires="300 ms")
        assert "/client" in member.adapter.loop.requirements
        await until(lambda: not member.adapter.loop.requirements)
        seen: list[object] = []
        watcher = RuntimePart()
        watcher.changed = lambda: seen.append(dict(member.adapter.loop.requirements))  # type: ignore[method-assign]
        member.runtime.parts.append(watcher)
        assert client._requirements is not None
        again: Any = {"header": {"stamp": float(next(iter(member.adapter.clients.expiries))[1])}}
        pairs: Any = [{"key": "noise", "value": "<= 5 cm"}, {"key": "expires", "value": "300 ms"}]
        message = client._requirements.make({**again, "status": [{"name": "x", "values": pairs}]})
        client._requirements.publish(message)
        await asyncio.sleep(0.5)
        assert not any(seen)
    await member.close()


async def test_cool_down_survives_a_restart(core: RosCore, tmp_path: Path) -> None:
    def broken() -> Resource:
        one = Resource("sonar", role="sensing")
        one.attribute("noise", better="min", unit="m")
        one.profile(offers={"noise": 0.01}, name="fine")(fine)
        one.profile(offers={"noise": 0.1}, cost=1, name="coarse")(lambda: None)
        one.adaptation(window="100 ms", cool_down="60 s")
        return one

    def fine() -> None:
        tried.append("fine")
        raise OSError("no bus")

    tried: list[str] = []
    path = tmp_path / "sonar.json"
    first = await started(core, path, broken())
    await until(lambda: first.adapter.loop.profile == "coarse")
    (before,) = cooling(first)
    await first.close()
    again = await started(core, path, broken())
    await until(lambda: again.adapter.loop.profile == "coarse")
    (after,) = cooling(again)
    assert after.until == pytest.approx(before.until, abs=2)
    assert (after.cool_down, after.why) == (60.0, "OSError: no bus")
    assert tried == ["fine"]
    # Somebody who has mended it need not wait.
    again.adapter.pin("fine")
    await until(lambda: len(tried) == 2)
    await until(lambda: again.adapter.loop.profile == "coarse")
    await again.close()


async def test_resource_runs_without_a_usable_store(core: RosCore, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    member = await started(core, tmp_path / "file" / "sonar.json")
    async with Node("watcher", master_uri=core.uri) as node:
        quality = await node.subscribe("/sonar/quality", "diagnostic_msgs/DiagnosticArray")
        async with asyncio.timeout(30):
            async for received in quality:
                if "nothing is kept" in received.message.status[0].message:
                    assert received.message.status[0].level == 1
                    break
    await member.close()


async def test_a_damaged_file_is_set_aside(core: RosCore, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "sonar.json"
    path.write_bytes(b"[" * 100_000)
    member = await started(core, path)
    assert "sonar.json is damaged" in caplog.text
    await member.configuration.set({"gain": 2.5})
    await until(lambda: path.exists() and b"2.5" in path.read_bytes())  # at once, not only at the end
    assert (tmp_path / "sonar.json.damaged").exists()
    await member.close()


async def test_a_second_process_keeps_nothing(
    core: RosCore, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "sonar.json"
    first = await started(core, path)
    await first.configuration.set({"gain": 2.5})
    other = RosCore(port=0)
    await other.start()
    second = await started(other, path)
    assert "nothing is kept: another process uses it; name this module otherwise, or set --state" in caplog.text
    assert second.resource.parameters["gain"].value == 1.0
    await second.close()
    await first.close()
    await other.close()
    assert b"2.5" in path.read_bytes()


async def test_storing_is_tried_again(core: RosCore, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "rmpa.resource")
    (tmp_path / "state").touch()
    member = await started(core, tmp_path / "state" / "sonar.json")
    await until(lambda: "nothing is kept" in member.adapter.health()[1])
    (tmp_path / "state").unlink()
    await until(lambda: "nothing is kept" not in member.adapter.health()[1])
    assert "everything is kept again" in caplog.text
    assert caplog.text.count("nothing is kept: ") == 1
    await member.close()
