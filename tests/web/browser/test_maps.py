"""Map, frames, panels and the form that publishes, in a real Chromium, with messages of real nodes by the hub."""

from __future__ import annotations

import json
import math
import struct
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import msgspec
import pytest

from lab.bed.chromium import Browser, Chromium
from rmpa.core.facts import TopicInfo
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node, Publisher
from rmpa.ros.types.codec import codec_for
from rmpa.ros.types.messages import MessageType
from rmpa.web.hub.node_link import FULL
from rmpa.web.server.agent_watch import AgentWatch
from tests.waiting import until
from tests.web.browser.conftest import Site
from tests.web.browser.test_pages import violations
from tests.web.clients.server import running_server
from tests.web.hub.client import listen, node
from tests.web.monitor.fake_server import STATIC
from tests.web.snapshots import Agent

TOPICS = {
    "/scan": "sensor_msgs/LaserScan",
    "/map": "nav_msgs/OccupancyGrid",
    "/plan": "nav_msgs/Path",
    "/tf": "tf2_msgs/TFMessage",
    "/tf_static": "tf2_msgs/TFMessage",
    "/goal": "geometry_msgs/PoseStamped",
}


class RealSite:
    """The pages of a real hub, and a node that publishes what they show.

    Args:
        page: The browser.
        port: Where the server listens.
        agent: Lists the topics.
        talker: The node.
    """

    def __init__(self, page: Chromium, port: int, agent: Agent, talker: Node) -> None:
        self.page, self.port, self.agent, self.talker = page, port, agent, talker
        self._publishers: dict[str, Publisher] = {}

    async def open(self, address: str) -> Chromium:
        await self.page.goto(f"http://127.0.0.1:{self.port}/pages?{time.monotonic()}#/{address}")
        await self.page.wait("document.querySelector('h1') && window.rmpa.state")
        return self.page

    def show(self, **changed: tuple[str, ...]) -> None:
        """The topics that the agent lists; publishers of some are changed."""
        topics = tuple(
            TopicInfo(name=name, type=kind, publishers=changed.get(name[1:], ("/talker",)))
            for name, kind in TOPICS.items()
        )
        self.agent.snapshot = msgspec.structs.replace(self.agent.snapshot, topics=topics)

    async def publish(self, topic: str, values: dict[str, Any], talker: Node | None = None) -> None:
        kind = MessageType(TOPICS[topic])
        talker = talker or self.talker
        key = f"{talker.name} {topic}"
        if key not in self._publishers:
            self._publishers[key] = await talker.advertise(topic, kind, latch=True)
        self._publishers[key].publish_raw(codec_for(kind).write(values, time.time_ns()).payload)


@pytest.fixture
async def real(core: RosCore, browser: Browser) -> AsyncIterator[RealSite]:
    agent = Agent(core.uri)
    watch = AgentWatch(agent.read)
    try:
        async with (
            running_server(core, FULL, watch=watch, static=STATIC) as server,
            node(core, "talker") as talker,
            Chromium(browser=browser) as page,
        ):
            await page.look(1280, 800)
            made = RealSite(page, server.port, agent, talker)
            made.show()
            yield made
    finally:
        await watch.close()


def header(frame: str) -> dict[str, Any]:
    return {"frame_id": frame, "stamp": "now"}


def transform(child: str, parent: str, x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> dict[str, Any]:
    turn = {"z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}
    moved = {"translation": {"x": x, "y": y}, "rotation": turn}
    return {"header": header(parent), "child_frame_id": child, "transform": moved}


def scan(frame: str) -> dict[str, Any]:
    """One range of 3.3 m straight ahead, and one to the left that was not measured."""
    about = {"angle_min": 0.0, "angle_increment": math.pi / 2, "range_min": 0.1, "range_max": 10.0}
    return {"header": header(frame), **about, "ranges": [3.3, 99.0]}


# How opaque a pixel of the map is at a place in metres, and its colour.
PIXEL = """(() => { const canvas = document.querySelector('.ground');
  const [x, y] = canvas.view.to(%s, %s).map((each) => Math.round(each * canvas.width / canvas.clientWidth));
  return [...canvas.getContext('2d').getImageData(x, y, 1, 1).data].join(); })()"""
SCALE = "document.querySelector('.ground').view.scale"


async def open_map(real: RealSite, *, moving: bool = False) -> Chromium:
    """With a scan whose point is at (2.3, 3.3) of the map, and a grid with a wall at (-4.75, -4.75)."""
    static = [transform("base", "odom", 1.0), transform("laser", "base", 1.0)]
    odom = transform("odom", "map", 2.3, -2.0, math.pi / 2)
    await real.publish("/tf_static", {"transforms": static if moving else [*static, odom]})
    if moving:
        await real.publish("/tf", {"transforms": [odom]})
    await real.publish("/scan", scan("laser"))
    cells = [0] * 400
    cells[0] = 100
    origin = {"position": {"x": -5.0, "y": -5.0}, "orientation": {"w": 1.0}}
    info = {"width": 20, "height": 20, "resolution": 0.5, "origin": origin}
    await real.publish("/map", {"header": header("map"), "info": info, "data": cells})
    await real.page.send(
        "Page.addScriptToEvaluateOnNewDocument",
        source="localStorage.getItem('rmpa.map') ?? localStorage.setItem('rmpa.map', '{\"frames\": false}')",
    )
    page = await real.open("map")
    await page.wait_text("map · 20")
    await page.wait_text("base · laser")
    return page


async def test_scan_and_grid_stand_where_tf_says(real: RealSite) -> None:
    page = await open_map(real, moving=True)
    # Forward of the laser is y of the map: 2 m of transforms and a range of 3.3 m, from y = -2.
    await page.wait(f"{PIXEL % (2.3, 3.3)} !== {PIXEL % (2.3, 3.7)} && {PIXEL % (2.3, 3.3)} !== {PIXEL % (2.7, 3.3)}")
    await page.wait(f"{PIXEL % (-4.75, -4.75)} !== {PIXEL % (-4.25, -4.25)}")
    assert await violations(page) == []
    await real.publish("/tf", {"transforms": [transform("odom", "map", 0.3, -2.0, math.pi / 2)]})
    await page.wait(f"{PIXEL % (2.3, 3.3)} !== {PIXEL % (2.3, 3.7)}")  # that scan was before
    await real.publish("/scan", scan("laser"))
    await page.wait(f"{PIXEL % (0.3, 3.3)} !== {PIXEL % (0.3, 3.7)} && {PIXEL % (2.3, 3.3)} === {PIXEL % (2.7, 3.3)}")
    assert page.errors == []


async def test_a_missing_transform_is_said_at_its_layer_and_ends_when_it_comes(real: RealSite) -> None:
    page = await open_map(real)
    await real.publish("/plan", {"header": header("lost"), "poses": [{}, {}]})
    await page.wait_text("no transform from lost to map: no node sends lost")
    await real.publish("/tf", {"transforms": [transform("lost", "map")]})
    await page.wait("!document.body.innerText.includes('no transform')")


async def test_what_is_old_is_grey_and_says_so(real: RealSite) -> None:
    page = await open_map(real)
    await page.wait(f"{PIXEL % (2.3, 3.3)} !== {PIXEL % (2.3, 3.7)}")
    colour = await page.run(PIXEL % (2.3, 3.3))
    real.show(scan=())
    await page.wait_text("its publisher has gone")
    await page.wait(f"{PIXEL % (2.3, 3.3)} !== {json.dumps(colour)} && {PIXEL % (2.3, 3.3)} !== {PIXEL % (2.3, 3.7)}")
    real.show()
    await page.wait(f"{PIXEL % (2.3, 3.3)} === {json.dumps(colour)}")


async def test_keys_wheel_and_fingers_move_and_zoom_the_map(real: RealSite) -> None:
    page = await open_map(real)
    await page.run("document.querySelector('.ground').focus()")
    await page.wait(f"{SCALE} !== 40")  # it shows all
    before = await page.run(SCALE)
    await page.press("+")
    await page.wait(f"{SCALE} > {before * 1.2}")
    x = await page.run("document.querySelector('.ground').view.x")
    await page.press("ArrowRight")
    await page.wait(f"document.querySelector('.ground').view.x > {x}")
    await page.press("0")
    await page.wait(f"Math.abs({SCALE} - {before}) < 1e-6")
    box = await page.run("(({x, y}) => ({x, y}))(document.querySelector('.ground').getBoundingClientRect())")
    at = {"x": box["x"] + 200, "y": box["y"] + 200}
    await page.send("Input.dispatchMouseEvent", type="mouseWheel", deltaX=0, deltaY=-100, **at)
    await page.wait(f"{SCALE} > {before * 1.1}")
    await page.press("0")
    await page.wait(f"Math.abs({SCALE} - {before}) < 1e-6")
    for kind, apart in (("touchStart", 40), ("touchMove", 80), ("touchMove", 120)):
        fingers = [{"x": at["x"] + side * apart, "y": at["y"], "id": side} for side in (-1, 1)]
        await page.send(
            "Input.dispatchTouchEvent", type=kind, touchPoints=[{**one, "id": one["id"] + 1} for one in fingers]
        )
    await page.send("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
    await page.wait(f"{SCALE} > {before * 2}")


async def test_layers_are_switched_and_the_frame_is_chosen_and_both_are_kept(real: RealSite) -> None:
    page = await open_map(real)
    await page.run(
        "[...document.querySelectorAll('.layers label')].find((e) => e.innerText.includes('/scan')).click()"
    )
    await page.wait(
        f"!document.body.innerText.includes('base · laser') && {PIXEL % (2.3, 3.3)} === {PIXEL % (2.3, 3.7)}"
    )
    await page.run("(() => { const frame = document.querySelector('select'); frame.value = 'odom';"
                   " frame.dispatchEvent(new Event('change', {bubbles: true})); })()")  # fmt: skip
    await page.wait("document.querySelector('.ground').ariaLabel.includes('in the frame odom')")
    page = await real.open("map")
    await page.wait_text("map · 20")
    await page.wait("document.querySelector('select').value === 'odom'")
    checked = "[...document.querySelectorAll('.layers .check')].map((e) => [e.querySelector('.mono')?.textContent, e"
    kept = await page.run(f"Object.fromEntries({checked}.querySelector('input').checked]))")
    assert kept == {"/scan": False, "/map": True, "/plan": True, "/goal": True, "undefined": False}


async def test_the_tree_of_frames_shows_senders_and_what_is_wrong(real: RealSite, core: RosCore) -> None:
    await real.publish("/tf_static", {"transforms": [transform("laser", "base")]})
    await real.publish("/tf", {"transforms": [transform("base", "odom", 1.5), transform("odom", "map")]})
    page = await real.open("tf")
    await page.wait(
        "[...document.querySelectorAll('tbody .frame')].map((e) => e.textContent).join() === 'map,odom,base,laser'"
    )
    assert await violations(page) == []
    static = "[...document.querySelectorAll('tbody tr')].at(-1).innerText"
    assert "static" in await page.run(static)
    await page.wait_text("1.500 m")
    real.show(tf=("/talker", "/rival"))
    async with node(core, "rival") as rival:
        await real.publish("/tf", {"transforms": [transform("base", "elsewhere")]}, rival)
        await page.wait_text("has 2 parents: odom and elsewhere")
        await real.publish("/tf", {"transforms": [transform("a", "b"), transform("b", "a")]}, rival)
        await page.wait_text("is in a loop: a → b → a")
        await page.wait_text("2 trees without a transform between them")


async def test_a_form_publishes_what_is_typed_and_says_what_is_wrong_at_its_field(real: RealSite) -> None:
    heard = await listen(real.talker, "/goal")
    page = await real.open("topic/%2Fgoal")
    await page.click("Fill in a message")
    await page.wait("document.querySelector('.fields')")
    label = "[...document.querySelectorAll('.fields label')].find((e) => e.textContent.trim() === %r)"
    field = f"{label}.querySelector('input')"

    async def fill(label: str, text: str) -> None:
        place = field % label
        await page.run(f"{place}.value = {text!r}; {place}.dispatchEvent(new Event('input', {{bubbles: true}})); 1")

    await fill("x float64", "1,5")
    await page.click("Publish once")
    await page.wait_text("write it as 1.5")
    await page.wait(
        f"document.activeElement === {field % 'x float64'} && document.activeElement.ariaInvalid === 'true'"
    )
    assert heard == []
    await fill("x float64", "nan")
    await fill("frame_id string", "map")
    await page.click("Publish once")
    await page.wait_text("Published once")
    await until(lambda: len(heard) == 1)
    seconds, _, size = struct.unpack_from("<3I", heard[0], 4)
    assert (abs(time.time() - seconds) < 60, heard[0][16 : 16 + size]) == (True, b"map")
    assert math.isnan(struct.unpack_from("<d", heard[0], 16 + size)[0])
    assert struct.unpack_from("<d", heard[0], len(heard[0]) - 8) == (1.0,)  # an orientation that turns nothing
    await page.click("Publish at a rate")
    await page.wait_text("goes on until this page leaves")
    await until(lambda: len(heard) > 2)
    assert await violations(page) == []
    await page.run("location.hash = '#/topics'; 1")
    await page.wait_text("flow between modules")
    count = len(heard)
    await page.run("new Promise((done) => setTimeout(done, 1500))")
    assert len(heard) <= count + 1


PANELS = "[...document.querySelectorAll('.slot h2')].map((each) => each.textContent)"


@asynccontextmanager
async def arranged(site: Site) -> AsyncIterator[Chromium]:
    page = await site.open("panels")
    yield page
    assert page.errors == []


async def add(page: Chromium, kind: str, **fields: str) -> None:
    await page.run(f"(() => {{ const kind = [...document.querySelectorAll('select')].at(-1); kind.value = {kind!r};"
                   " kind.dispatchEvent(new Event('change', {bubbles: true})); })()")  # fmt: skip
    for label, text in fields.items():
        place = f"[...document.querySelectorAll('form label')].find((e) => e.innerText.startsWith({label!r}))"
        await page.wait(place)
        await page.run(f"(() => {{ const field = {place}.querySelector('input'); field.value = {text!r};"
                       " field.dispatchEvent(new Event('input', {bubbles: true})); })()")  # fmt: skip
    await page.click("Add")


async def test_panels_are_added_moved_sized_and_kept_by_name(site: Site) -> None:
    async with arranged(site) as page:
        await add(page, "message", Topic="/odom")
        await page.wait_text("child_frame_id")
        await page.run(
            "[...document.querySelectorAll('.slot button.field')].find((e) => e.title.endsWith('position.x')).click()"
        )
        await page.wait(f"{PANELS}.join() === 'Message /odom,Plot /odom'")
        await add(page, "map")
        await add(page, "log")
        await page.wait(f"{PANELS}.length === 4 && document.querySelector('.slot .ground')")
        await page.run("document.querySelector('[aria-label=\"Later: Message /odom\"]').click()")
        await page.wait(f"{PANELS}.join() === 'Plot /odom,Message /odom,Map,Log'")
        await page.run("document.querySelector('[aria-label=\"Wider: Map\"]').click()")
        await page.wait("document.querySelector('.w3.h2')")
        assert await violations(page) == []
        await page.look(390, 800, dark=False)
        assert await page.run("document.documentElement.scrollWidth") == 390
        assert await violations(page) == []
        await site.open("panels")
        await page.wait(f"{PANELS}.join() === 'Plot /odom,Message /odom,Map,Log'")


FILE = """(() => { const field = document.querySelector('input[type=file]'), files = new DataTransfer();
  files.items.add(new File([%s], 'given.json')); field.files = files.files;
  field.dispatchEvent(new Event('change', {bubbles: true})); })()"""


async def test_panels_go_to_a_file_and_back_and_a_wrong_file_changes_nothing(site: Site) -> None:
    async with arranged(site) as page:
        await add(page, "message", Topic="/odom")
        await page.wait(f"{PANELS}.length === 1")
        await page.run("URL.createObjectURL = (blob) => { window.saved = blob; return '#'; }; 1")
        await page.click("Export")
        text = await page.run("window.saved.text()")
        for given, said in (
            ("{", "it is not JSON"),
            ("[]", "its format is not"),
            (text.replace("message", "virus"), "panel 1 is of no known kind: virus"),
            (text.replace("/odom", "odom"), "panel 1 has no topic"),
            (json.dumps({"format": "rmpa-panels-1", "panels": [{"kind": "log"}] * 13}), "12 are shown at most"),
            (json.dumps({"format": "rmpa-panels-1", "panels": [{"kind": "drive"}] * 2}), "second drive panel"),
            (" " * 70_000, "larger than 64 kB"),
        ):
            await page.run(FILE % json.dumps(given))
            await page.wait_text(said)
        assert await page.run(PANELS) == ["Message /odom"]
        other = {"format": "rmpa-panels-1", "name": "Two", "panels": [{"kind": "log", "wide": 99}, {"kind": "map"}]}
        await page.run(FILE % json.dumps(json.dumps(other)))
        await page.wait(f"{PANELS}.join() === 'Log,Map' && document.querySelector('.slot.w1')")
        names = "[...document.querySelector('select').options].map((each) => each.value).join()"
        assert await page.run(names) == "Panels,Two"
