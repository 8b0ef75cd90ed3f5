"""``rmpa web`` beside real agents and nodes: what a user at a tablet sees and does, and what happens then."""

from __future__ import annotations

import asyncio
import json
import time
from pathlib import Path
from typing import Final

import pytest

from lab.bed.agents import RMPA, Agent
from lab.bed.chromium import Chromium
from lab.bed.http_client import http_client
from lab.bed.namespaces import Lab
from lab.bed.processes import DEADLINE, Process
from rmpa.web.monitor.limits import DRIVE_SPEED
from tests.interop.conftest import AgentFactory, ModuleFactory, ShellFactory, WebFactory
from tests.interop.modules import Module
from tests.interop.web import needs_browser
from tests.web.monitor.page import Page

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(150)]

CAMERA: Final = Path(__file__).parent / "resources" / "camera.py"
# Seconds within which a change shows.
SHOWN: Final = 1.5
# Seconds within which a robot is stopped whose driver has gone.
STOPPED: Final = 1.0
# What an arrow key commands, m/s: its share of the stick, of what the page's slider says at first.
HELD: Final = 0.6 * 0.15 * DRIVE_SPEED
# What a talker's live value counts.
NUMBER: Final = "Number(/message (\\d+)/.exec(document.querySelector('.tree')?.innerText)?.[1])"


async def restart(agent: Agent) -> None:
    """Start an agent again that was killed; return when it is ready."""
    agent.process.end()
    agent.start()
    await asyncio.to_thread(agent.wait_ready)


async def goes_on(page: Chromium, more: int = 10) -> None:
    """Wait until the live value has counted on."""
    await page.wait(f"{NUMBER} > 0")
    first = await page.run(NUMBER)
    await page.wait(f"{NUMBER} >= {first + more}")


def link_age(module: Module, peer: str) -> float:
    """Seconds since a link came up, by its agent."""
    return min(each.link.up_ago for each in module.agent.snapshot().peers if each.name == peer and each.link)


@needs_browser
async def test_a_killed_module_its_return_and_a_new_topic_show_at_once(
    lab: Lab, modules: ModuleFactory, web: WebFactory
) -> None:
    base, arm = modules("base", "arm")
    served = web(base.agent)
    async with Chromium(lab.host("tablet", 0)) as page:
        await served.open(page)
        up = "document.querySelector('[data-module=arm]').classList.contains('up')"
        await page.wait(up)
        await page.wait("document.querySelector('[data-module=base]').classList.contains('here')")
        gone, back = [], []
        for _ in range(3):  # the best of three: other tests may have the processor
            killed = time.monotonic()
            arm.agent.kill()
            await page.wait(f"!{up}")
            gone.append(time.monotonic() - killed)
            await restart(arm.agent)
            await page.wait(up)
            back.append(link_age(base, "arm"))
        assert min(gone) < SHOWN
        assert min(back) < SHOWN

        await page.run("location.hash = '#/topics'")
        await page.wait_text("flow between modules")
        arm.ros.rospy("talker", "__name:=talker", topic="/chatter", rate=20, type="String")
        await page.wait_text("/chatter")
        await page.run("location.hash = '#/topic/%2Fchatter'")
        await page.click("On")
        await goes_on(page)
        await page.wait_text("arm → base")
        await page.run("location.hash = '#/'")
        await page.wait(
            "document.querySelector('[aria-label=\"Flows between modules\"]').innerText.includes('/chatter')"
        )
        assert page.errors == []


@needs_browser
@pytest.mark.long
async def test_a_resource_of_another_module_is_followed_and_its_profile_chosen(
    lab: Lab, agent: AgentFactory, shell: ShellFactory, web: WebFactory, tmp_path: Path
) -> None:
    here, there, tablet = lab.hosts("base", "cam", "tablet")
    base = Module(here, agent(here, name="base"), shell(here))
    served = web(base.agent, "--control")
    camera = Agent(there, tmp_path, name="cam")  # its rmpa run has an agent of its own
    command = there.command([RMPA, "run", CAMERA, "--name", camera.name])
    with Process(command, env=camera.env, name="camera.py") as running:
        async with Chromium(tablet) as page:
            await running.expect("active on", 40.0)
            await served.open(page, "resources")
            row = "document.querySelector('[aria-label=\"Smart Resources\"] tbody').innerText"
            await page.wait(f"/camera[^]*cam[^]*OK[^]*(full|small|rescue)/.test({row})")
            await page.run("location.hash = '#/resource/cam%3A%2Fcamera'")
            driver = base.ros.rospy("quality_client", commands=True, name="driver", observe="/camera/frames")
            await driver.expect_event("up")
            driver.tell(json.dumps({"rate": ">= 10 Hz hard", "sharpness": ">= 640"}))
            await page.wait_text("full runs")
            await page.wait_text("sharpness")
            await page.wait("document.querySelector('[aria-label=Clients]').innerText.includes('driver')")

            mark = driver.mark_events()
            await page.click("Choose", "[...document.querySelectorAll('[aria-label=Profiles] tr')].at(2)")
            await page.wait_text("small, by hand")
            await page.wait_text("small runs")
            await driver.expect_event("profile", where=lambda event: event["name"] == "small", since=mark)
            await page.click("Let it decide")
            await page.wait_text("full runs")

            await page.run("location.hash = '#/alarms'")
            await page.wait_text("There is no alarm")
            driver.tell(json.dumps({"rate": ">= 50 Hz hard"}))
            await page.wait("document.querySelector('[aria-label=Alarms]').innerText.includes('cam:/camera')")
            assert page.errors == []


@needs_browser
async def test_the_page_goes_on_by_itself_when_the_agent_was_killed_and_is_back(
    lab: Lab, modules: ModuleFactory, web: WebFactory
) -> None:
    base, arm = modules("base", "arm")
    served = web(base.agent)
    arm.ros.rospy("talker", "__name:=talker", topic="/chatter", rate=20, type="String")
    clerk = base.ros.rospy("text_teller", commands=True, name="clerk")
    await clerk.expect_event("up")
    async with Chromium(lab.host("tablet", 0)) as page:
        await served.open(page, "log")
        clerk.tell(json.dumps({"log": "the gripper is cold"}))
        await page.wait_text("the gripper is cold")
        await page.run("location.hash = '#/topic/%2Fchatter'")
        await page.click("On")
        await goes_on(page)

        base.agent.kill()
        await page.wait_text("The agent has not answered")
        await restart(base.agent)
        await page.wait("!document.querySelector('.banner')")
        await goes_on(page)
        await page.run("location.hash = '#/'")
        await page.wait("document.querySelector('[data-module=arm]').classList.contains('up')")
        await page.run("location.hash = '#/log'")
        await page.wait_text("the gripper is cold")
        clerk.tell(json.dumps({"log": "the gripper is warm"}))
        await page.wait_text("the gripper is warm")


@needs_browser
async def test_a_joystick_drives_a_robot_of_another_module_until_its_browser_is_killed(
    lab: Lab, modules: ModuleFactory, web: WebFactory
) -> None:
    base, arm = modules("base", "arm")
    looking, driving = web(base.agent, "--control"), web(base.agent, "--drive", port=8481)
    tablet = lab.host("tablet", 0)
    wheels = arm.ros.rospy("wheels", name="wheels", topic="/cmd_vel")
    await wheels.expect_event("up")
    async with http_client(tablet) as http, looking.monitor(http) as monitor:
        assert "drive" not in monitor.hello["may"]
        await monitor.drive(1.0)
        assert "may not drive" in (await monitor.next("failed"))["error"]
        assert "Publishers: None" in await asyncio.to_thread(arm.ros.tool, "rostopic", "info", "/cmd_vel")
    async with Chromium(tablet) as page:
        await driving.open(page, "drive")
        await page.wait("document.querySelector('.stick.off')")
        await page.run("document.querySelector('input[type=checkbox]').click()")
        await page.wait("document.querySelector('.stick:not(.off)')")
        await page.run("document.querySelector('.stick').focus()")
        await page.down("ArrowUp")
        await wheels.expect_event("speed", where=lambda event: event["linear"] == pytest.approx(HELD))
        held = wheels.mark_events()
        await wheels.expect_event("speed", since=held + 4)
        assert all(event["linear"] == pytest.approx(HELD) for event in wheels.events("speed", since=held))
        assert page.errors == []

        held = wheels.mark_events()
        killed = time.time_ns()
        await page.kill()
        stopped = await wheels.expect_event("speed", where=lambda event: event["linear"] == 0, since=held)
        assert (int(str(stopped["at"])) - killed) * 1e-9 < STOPPED
        assert stopped["angular"] == 0
        async with http_client(tablet) as http:
            await driving.wait_counts(http, "rmpa_web_clients", "protocol", lambda found: not found)
        assert wheels.events("speed")[-1]["linear"] == 0


@needs_browser
async def test_pages_of_two_modules_share_one_stick(lab: Lab, modules: ModuleFactory, web: WebFactory) -> None:
    """Each module has a server and a page of its own, and both drive the robot of one of them."""
    base, arm = modules("base", "arm")
    servers = web(base.agent, "--drive"), web(arm.agent, "--drive")
    tablet, phone = lab.host("tablet", 0), lab.host("phone", 0)
    wheels = arm.ros.rospy("wheels", name="wheels", topic="/cmd_vel")
    await wheels.expect_event("up")
    holder = "document.querySelector('.chain').innerText"
    async with Chromium(tablet) as first, Chromium(phone) as second:
        for page, served in zip((first, second), servers, strict=True):
            await served.open(page, "drive")
            await page.wait(f"{holder}.includes('is free')")
        await second.wait(f"/arm\\s+\\/wheels/.test({holder})")
        await first.run("document.querySelector('input[type=checkbox]').click()")
        await second.wait(f"/The page of [0-9.]+\\s+at base, for/.test({holder})")
        await first.run("document.querySelector('.stick').focus()")
        await first.down("ArrowUp")
        await wheels.expect_event("speed", where=lambda event: event["linear"] == pytest.approx(HELD))
        await first.wait(f"{holder}.includes('arm')")  # who takes it, now that it is published
        mark = wheels.mark_events()
        await second.click("Take over")
        await first.wait_text("at arm has taken the stick over")
        await second.wait(f"{holder}.includes('This page')")
        await wheels.expect_event("speed", where=lambda event: event["linear"] == 0, since=mark)
        await second.run("document.querySelector('.stick').focus()")
        await second.down("ArrowDown")
        await wheels.expect_event("speed", where=lambda event: event["linear"] == pytest.approx(-HELD))
        mark = wheels.mark_events()
        await wheels.expect_event("speed", since=mark + 5)
        assert all(float(str(event["linear"])) <= 0 for event in wheels.events("speed", since=mark)), (
            "none of the first page"
        )
        await first.click("Stop the robot")
        await second.wait_text("at base has stopped the robot")
        await wheels.expect_event("speed", where=lambda event: event["linear"] == 0, since=mark)
        assert first.errors == second.errors == []
        await second.kill()


@needs_browser
async def test_a_robot_does_not_move_by_what_tcp_kept_while_the_network_was_away(
    lab: Lab, modules: ModuleFactory, web: WebFactory
) -> None:
    """The stick is held, the network goes, the stick is let go, the network is back: the robot stays where it is."""
    (base,) = modules("base")
    driving = web(base.agent, "--drive")
    tablet = lab.host("tablet", 0)
    wheels = base.ros.rospy("wheels", name="wheels", topic="/cmd_vel")
    await wheels.expect_event("up")
    async with Chromium(tablet) as page:
        await driving.open(page, "drive")
        await page.wait("document.querySelector('.stick.off')")
        await page.run("document.querySelector('input[type=checkbox]').click()")
        await page.wait("document.querySelector('.stick:not(.off)')")
        await page.run("document.querySelector('.stick').focus()")
        for outage in (1.0, 3.0):
            mark = wheels.mark_events()
            await page.down("ArrowUp")
            await wheels.expect_event("speed", where=lambda event: event["linear"] == pytest.approx(HELD), since=mark)
            cut = asyncio.create_task(asyncio.to_thread(tablet.outage, outage))
            await wheels.expect_event("speed", where=lambda event: event["linear"] == 0, since=mark + 2)
            mark = wheels.mark_events()
            await page.up("ArrowUp")
            await cut
            await page.wait("document.body.innerText.includes('late, and are dropped')")
            assert not [event for event in wheels.events("speed", since=mark) if event["linear"]]
        assert page.errors == []


async def test_what_is_asked_of_a_peer_is_answered(lab: Lab, modules: ModuleFactory, web: WebFactory) -> None:
    base, arm = modules("base", "arm")
    served = web(base.agent, "--control")
    switch = arm.ros.rospy("switch", name="switch")
    arm.ros.rospy("talker", "__name:=talker", topic="/chatter", rate=20)
    heard = base.ros.rospy("listener", topic="/chatter")
    async with http_client(lab.host("tablet", 0)) as http, served.monitor(http) as monitor:
        await parameters(base, "", monitor)
        await parameters(arm, "arm", monitor)

        about = await monitor.answered("describe", service="/switch", peer="arm")
        assert (about["type"], about["request"]) == ("std_srvs/SetBool", {"data": False})
        assert "string message" in about["text"]
        answer = await monitor.answered("call", service="/switch", peer="arm", request={"data": True})
        assert answer["response"] == {"success": True, "message": "on"}
        assert answer["seconds"] < DEADLINE
        assert [event["data"] for event in switch.events("call")] == [True]
        failed = await monitor.ask("call", service="/switch", peer="arm", request={"date": True})
        assert "date" in failed
        failed = await monitor.ask("call", service="/switch", peer="base", request={})
        assert "of arm" in failed
        assert len(switch.events("call")) == 1

        await heard.expect_event("first")
        (way,) = await monitor.answered("why", kind="topic", name="/chatter")
        assert (way["peer"], way["node"], way["to"], way["flows"]) == ("arm", "/talker", "base", True)
        (way,) = await monitor.answered("why", kind="topic", name="/nothing")
        assert not way["flows"]
        assert "neither base nor a linked peer (arm) publishes /nothing" in way["stages"][-1]["text"]
        (way,) = await monitor.answered("why", kind="service", name="/switch", peer="arm")
        assert way["flows"]
        (way,) = await monitor.answered("why", kind="topic", name="/chatter", peer="leg")
        assert "knows no peer 'leg'" in way["stages"][0]["text"]


async def parameters(module: Module, peer: str, monitor: Page) -> None:
    """Set, read and delete a module's parameters as a page does, beside the stock rosparam."""

    async def rosparam(*words: str) -> str:
        return (await asyncio.to_thread(module.ros.tool, "rosparam", *words)).strip()

    values = await monitor.answered("set_param", peer=peer, name="/gains/p", value=1.5)
    assert values["values"]["gains"] == {"p": 1.5}
    assert await rosparam("get", "/gains/p") == "1.5"
    await rosparam("set", "/gains/names", "[a, b]")
    await monitor.answered("params", lambda found: found["values"]["gains"].get("names") == ["a", "b"], peer=peer)
    values = await monitor.answered("delete_param", peer=peer, name="/gains/p")
    assert values["values"]["gains"] == {"names": ["a", "b"]}
    assert "/gains/p" not in (await rosparam("list")).split()
    assert "null" in await monitor.ask("set_param", peer=peer, name="/gains/i", value=None)
    assert "not a name" in await monitor.ask("set_param", peer=peer, name="gains", value=1)
