"""The monitor's pages in a real Chromium: what is shown, what changes, keys, sizes, colours, and what is kept out."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest

from lab.bed.chromium import Chromium
from rmpa.web.hub.node_link import Rights
from tests.web.browser.conftest import Site

AXE = Path(__file__).with_name("vendor") / "axe.min.js"
# Each page, and a text that it shows of the demo.
PAGES = {
    "": "Nothing is wrong.",
    "module/base": "Found by",
    "module/pc": "Counted by the agent",
    "topics": "/velocity_order",
    "topic/%2Fodom": "bridge.allow has",
    "services": "/base/set_parameters",
    "nodes": "Of peers, the nodes",
    "node/base%3A%2Fbase": "/rmpa/base/base",
    "service/base%3A%2Fbase%2Fset_parameters": "std_srvs/SetBool",
    "params": "rosdistro",
    "resources": "a simulated Turtlebot",
    "resource/velocity%3A%2Fvelocity": "For a robot that carries a full glass",
    "map": "Fixed frame",
    "tf": "No topic has the type tf2_msgs/TFMessage",
    "panels": "Add what is to be shown",
    "alarms": "All that is wrong",
    "log": "turn",
    "diagnostics": "No node has said anything yet",
    "graph": "/velocity_order",
    "drive": "The robot may move",
}


async def violations(page: Chromium) -> list[str]:
    """What axe-core finds, each with the rule and the element."""
    if not await page.run("!!window.axe"):
        await page.run(AXE.read_text(encoding="utf-8") + "; true")
    found: list[Any] = await page.run(
        "axe.run(document).then((done) => done.violations.flatMap((rule) => rule.nodes.map((node) =>"
        " `${rule.id}: ${node.html.slice(0, 160)} ${node.failureSummary.slice(0, 200)}`)))"
    )
    return [str(each) for each in found]


# What is too small for a finger.
SMALL = """
[...document.querySelectorAll('.top a, .top button, main button:not(.field), .module, .concerns a,'
  + ' input:not([type=checkbox]), select')]
  .map((each) => [each.outerHTML.slice(0, 80), each.getBoundingClientRect()])
  .filter(([, box]) => box.width && (box.height < 43.5 || box.width < 43.5)).map(([text]) => text)"""
# Of the page; innerWidth grows with what is too wide.
WIDTH = "document.documentElement.scrollWidth"


@pytest.mark.parametrize("address", PAGES)
async def test_a_page_shows_its_thing_and_is_accessible_in_both_colours_and_on_a_phone(
    site: Site, address: str
) -> None:
    page = await site.open(address)
    await page.wait_text(PAGES[address])
    assert await violations(page) == []
    await page.look(360, 740, dark=False)
    assert await violations(page) == []
    assert (await page.run(WIDTH), await page.run(SMALL)) == (360, [])
    assert (site.server.reports, page.errors) == ([], [])


@pytest.mark.parametrize("scene", ["sick", "mute", "large"])
async def test_the_first_page_is_accessible_whatever_is_wrong(site: Site, scene: str) -> None:
    """Further scenes are checked where they are tested."""
    page = await site.open("", scene)
    assert await violations(page) == []
    await page.look(360, 800, dark=False)
    assert await violations(page) == []
    assert await page.run(WIDTH) == 360


async def test_a_small_screen_shows_the_tables_of_the_first_page_whole(site: Site) -> None:
    await site.page.look(1280, 900)
    page = await site.open()
    await page.wait("document.querySelector('.beside table').innerText.includes('kB/s')")
    cut = "[...document.querySelectorAll('.scroll')].filter((each) => each.scrollWidth > each.clientWidth)"
    assert await page.run(f"{cut}.map((each) => each.ariaLabel)") == []


async def test_the_links_of_all_pages_fit_a_notebook_and_a_phone_shows_that_of_the_page(site: Site) -> None:
    await site.page.look(1280, 800)
    page = await site.open("drive")
    row = "document.querySelector('.top nav')"
    await page.wait(f"{row}.scrollWidth === {row}.clientWidth")
    await page.look(390, 844)
    await page.run("location.hash = '#/log'")
    link = "document.querySelector('.top nav [aria-current]')"
    await page.wait(f"{link}.textContent === 'Log' && {link}.getBoundingClientRect().right <= innerWidth")


async def test_the_keyboard_reaches_everything(site: Site) -> None:
    page = await site.open()
    await page.press("/")
    await page.wait("document.activeElement.type === 'search'")
    for key in "vel order":
        await page.press(key)
    await page.press("Enter")
    await page.wait("location.hash === '#/topic/%2Fvelocity_order' && !document.querySelector('dialog')")
    for key in "gr":
        await page.press(key)
    await page.wait("location.hash === '#/resources' && document.activeElement.textContent === 'Smart Resources'")
    await page.press("?")
    await page.wait("document.querySelector('dialog').textContent.includes('Around the ring')")
    await page.press("Escape")
    await page.wait("!document.querySelector('dialog')")
    for key in "gm":
        await page.press(key)
    await page.wait("document.querySelector('[data-module=pc]')")
    await page.run("document.querySelector('[data-module=pc]').focus()")
    seen = []
    for _ in range(4):
        await page.press("ArrowRight")
        seen.append(await page.run("document.activeElement.dataset.module"))
    assert sorted(seen) == ["base", "joystick", "pc", "velocity"]
    await page.run("document.querySelector('[data-module=base]').focus()")
    await page.press("Enter")
    await page.wait("document.querySelector('h1').textContent === 'base'")


async def test_the_colours_can_be_chosen_and_stay(site: Site) -> None:
    page = await site.open()
    ground = "getComputedStyle(document.documentElement).backgroundColor"
    dark = await page.run(ground)
    await page.press("c")
    await page.wait(f"{ground} !== {json.dumps(dark)}")
    await page.goto(f"http://127.0.0.1:{site.port}/?again")
    await page.wait(f"document.querySelector('h1') && {ground} !== {json.dumps(dark)}")


MOVED = "window.moved.filter((each) => each.classList.contains('medium')).length"


async def test_only_what_flows_moves_and_nothing_where_motion_is_to_be_reduced(site: Site) -> None:
    # Drawn all the time, without a frame in between: a change of the setting must not be missed.
    await site.page.send(
        "Page.addScriptToEvaluateOnNewDocument", source="window.requestAnimationFrame = (draw) => setTimeout(draw, 0)"
    )
    page = await site.open()
    await page.run("setInterval(() => window.rmpa.changed(), 0); true")
    await page.run(
        "window.moved = []; new MutationObserver((all) => window.moved.push(...all.map((each) => each.target)"
        ".filter((each) => each.closest('.ring')))).observe(document.body, {attributes: true, subtree: true}); true"
    )
    assert await page.run("document.getAnimations().length") == 0
    await page.look(still=False)
    await page.wait(f"{MOVED} > 3")
    assert await page.run("window.moved.every((each) => each.closest('.streams') && each.tagName === 'g')") is True
    assert await page.run("document.querySelectorAll('.streams .stream').length") == 5
    await page.look(still=True)
    await page.run("new Promise((done) => { let n = -1; const rest = () => window.moved.length === n ? done()"
                   " : (n = window.moved.length, setTimeout(rest, 500)); rest(); })")  # fmt: skip


async def test_the_first_page_is_small(site: Site) -> None:
    page = await site.open()
    sizes: dict[str, int] = await page.run(
        "Object.fromEntries(['navigation', 'resource'].flatMap((kind) => performance.getEntriesByType(kind))"
        ".map((each) => [each.name, each.transferSize]))"
    )
    assert 5 < len(sizes) < sum(sizes.values()) < 250_000
    assert not [name for name in sizes if "uPlot" in name]
    assert all(name.startswith(f"http://127.0.0.1:{site.port}/") for name in sizes)


async def test_names_and_values_of_others_are_text(site: Site) -> None:
    page = await site.open("topic/%2Fjoystick%2Fprofile")
    await page.click("On")
    await page.wait_text("<script>alert(1)</script>")
    await page.wait_text("200 elements")
    evil = "<img src=x onerror='window.owned=1'>"
    patch = {"modules": {evil: {"state": "up"}}, "notes": ["<b id=owned>note</b>"]}
    await receive(page, patch)
    await page.run("location.hash = '#/'")
    await page.wait_text("<b id=owned>note</b>")
    assert await page.run("window.owned === undefined && !document.getElementById('owned')") is True
    await receive(page, {"__proto__": {"polluted": 1}, "topics": {"__proto__": {"polluted": 1}}})
    assert await page.run("({}).polluted === undefined") is True


async def receive(page: Chromium, patch: dict[str, Any]) -> None:
    """Let the page take a patch as if the server had sent it."""
    message = json.dumps({"op": "patch", "n": 0, "patch": patch})
    await page.run(f"window.rmpa.receive({json.dumps(message)}); true")


async def test_live_values_poses_and_chosen_fields_are_drawn(site: Site) -> None:
    page = await site.open("topic/%2Fodom")
    await page.click("On")
    await page.wait_text("base_link")
    await page.wait("/x -?\\d+\\.\\d\\d m, y/.test(document.querySelector('.about').textContent)")
    await page.wait("document.querySelector('[title=\"Plot twist.twist.linear.x\"]')")
    await page.run("document.querySelector('[title=\"Plot twist.twist.linear.x\"]').click()")
    await page.wait(
        "[...document.querySelectorAll('.plot')].some((each) => each.ariaLabel.includes('twist.twist.linear.x 0.'))"
    )
    await page.wait("document.querySelectorAll('.uplot canvas').length === 2")
    assert (site.server.reports, page.errors) == ([], [])


COLOURS = """(() => { const view = document.querySelector('canvas.view, canvas.ground');
  const data = view.getContext('2d').getImageData(0, 0, view.width, view.height).data;
  return new Set(new Uint32Array(data.buffer)).size; })() > 5"""


async def test_a_scan_is_drawn_and_says_how_old_it_is_when_it_stops(site: Site) -> None:
    page = await site.open("topic/%2Fscan", "sensors")
    await page.click("On")
    await page.wait("document.querySelector('.layers .about')?.innerText.includes('Hz')")
    await page.wait(COLOURS)
    assert await page.run("document.querySelector('.layers .mark.idle')") is None
    site.server.publishes = False
    await page.wait("document.querySelector('.layers .mark.idle')")
    site.server.publishes = True
    await page.wait("!document.querySelector('.layers .mark.idle')")
    assert (site.server.reports, page.errors) == ([], [])


async def test_a_picture_is_drawn_and_greyed_with_its_age_when_it_stops(site: Site) -> None:
    page = await site.open("topic/%2Fcamera%2Fimage", "sensors")
    await page.click("On")
    await page.wait("document.querySelector('.beat')?.innerText.includes('Hz · ')")
    await page.wait(COLOURS)
    assert await page.run("document.querySelector('.fresh.old')") is None
    site.server.publishes = False
    await page.wait("document.querySelector('.fresh.old .beat')?.innerText.includes('Nothing comes any more')")
    await page.wait("/last message is \\d+.s old, before that/.test(document.querySelector('.beat').innerText)")
    live = "document.querySelector('[aria-label=\"Live messages\"]').parentNode.innerText"
    assert "nothing comes" in await page.run(live)
    assert await page.run("getComputedStyle(document.querySelector('canvas.view')).filter") == "grayscale(1)"
    assert await violations(page) == []
    site.server.publishes = True
    await page.wait("document.querySelector('.fresh:not(.old) .beat')")
    assert "nothing comes" not in await page.run(live)
    assert (site.server.reports, page.errors) == ([], [])


async def test_a_raw_image_says_its_true_size_fits_its_place_and_offers_the_compressed_one(site: Site) -> None:
    await site.page.look(390, 800)
    page = await site.open("topic/%2Fcamera%2Fraw", "sensors")
    await page.click("On")
    await page.wait("/^1280 . 720 · bgr8 · drawn as 426 . 240/.test(document.querySelector('figcaption').innerText)")
    colour = "[...document.querySelector('canvas.view').getContext('2d').getImageData(9, 200, 1, 1).data]"
    assert await page.run(colour) == [255, 0, 0, 255]
    await page.wait("/B.s cross the mesh from base/.test(document.querySelector('figure').innerText)")
    await page.click("Show /camera/raw/compressed instead")
    await page.wait("document.querySelector('figcaption').innerText.includes(' · png · ')")
    assert "cross the mesh" not in await page.run("document.querySelector('figure').innerText")
    assert (site.server.reports, page.errors) == ([], [])


ROWS = "[...document.querySelectorAll('tbody tr')].map((row) => row.innerText)"


async def test_topics_are_sorted_by_their_measured_rate_and_back_brings_the_list_as_it_was(site: Site) -> None:
    page = await site.open("topics", "large")
    await page.click("All")
    await page.wait("document.querySelectorAll('tbody tr').length === 200")
    await page.run(
        "(() => { const field = document.querySelector('.filter'); field.value = 'module_';"
        " field.dispatchEvent(new Event('input', {bubbles: true})); })()"
    )
    await page.run("[...document.querySelectorAll('button.sort')].find((b) => b.innerText.trim() === 'Rate').click()")
    await page.wait("document.querySelector('[aria-sort=descending]')")
    assert "6" in (await page.run(ROWS))[0].split("\t")[1]
    await page.wait("document.querySelectorAll('tbody tr').length === 200")
    await page.run("scrollTo(0, 2000)")
    before = await page.run(ROWS)
    await page.run("document.querySelectorAll('tbody a')[30].click()")
    await page.wait("document.querySelector('h1').innerText.startsWith('/module_') && scrollY === 0")
    await page.run("history.back()")
    await page.wait("document.querySelector('h1').innerText === 'Topics' && scrollY === 2000")
    assert await page.run("document.querySelector('.filter').value") == "module_"
    assert [row.split()[0] for row in await page.run(ROWS)] == [row.split()[0] for row in before]
    assert await page.run("document.querySelector('[aria-checked=true]').innerText") == "All"
    await page.run("location.hash = '#/'")
    await page.wait("document.querySelector('.ring')")
    await page.run("location.hash = '#/topics'")
    await page.wait("document.querySelector('.filter')")
    assert await page.run("document.querySelector('.filter').value") == ""


async def test_the_line_of_a_lost_connection_stays_in_sight(site: Site) -> None:
    page = await site.open("topics", "large")
    await page.wait("document.querySelectorAll('tbody tr').length > 100")
    site.server.agent.scene = "mute"
    await page.wait("document.querySelector('.banner')")
    for width in (1280, 390):
        await page.look(width, 700)
        await page.run("scrollTo(0, 3000)")
        await page.wait("scrollY > 2000")
        assert await page.run("document.querySelector('.banner').getBoundingClientRect().top") >= 0


async def test_why_says_where_the_way_ends(site: Site) -> None:
    page = await site.open("topic/%2Fodom", "killed")
    await page.press("w")
    await page.wait_text("no linked peer publishes it")
    await page.wait_text("start the module base")


async def test_a_module_tells_its_agents_figures_its_lanes_and_why(site: Site) -> None:
    page = await site.open("module/base")
    await page.wait_text("4.2")
    await page.wait_text("large messages")
    for text in ("base-nuc", "of a core", "61 of 1,024"):
        assert text in await page.run("document.querySelector('main').innerText")
    assert await page.run("[...document.querySelectorAll('main a')].some((each) => each.textContent === '/base')")
    await page.press("w")
    await page.wait_text("It is reached")
    assert site.server.asked[-1].args == {"kind": "module", "name": "base"}


async def test_a_node_shows_its_topics_services_connections_and_log(site: Site) -> None:
    page = await site.open("node/base%3A%2Fbase")
    await page.wait_text("4711")
    await page.wait_text("connected")
    for text in ("/odom", "set_parameters", "of base"):
        assert text in await page.run("document.querySelector('main').innerText")
    await page.run("location.hash = '#/topic/%2Fodom'")
    await page.wait("[...document.querySelectorAll('main a')].some((each) => each.hash === '#/node/base%3A%2Fbase')")
    assert (site.server.reports, page.errors) == ([], [])


async def fill(page: Chromium, field: str, text: str, event: str = "change") -> None:
    """Give a field of a page, which a selector finds, a value, as a user does."""
    place = f"document.querySelector({json.dumps(field)})"
    told = f"{place}.dispatchEvent(new Event('{event}', {{bubbles: true}}))"
    await page.run(f"{place}.value = {json.dumps(text)}; {told}")


LINES = "[...document.querySelectorAll('.logline')].map((each) => each.innerText.replace(/\\s+/g, ' '))"


async def test_the_log_of_all_modules_is_one_and_each_filter_chooses_of_it(site: Site) -> None:
    site.server.logs["base"].add("/base", 8, time.time_ns(), b"the motor is hot")
    page = await site.open("log")
    await page.wait_text("the motor is hot")
    shown = " ".join(await page.run(LINES))
    for text in ("pc:/pc", "base:/base", "velocity agent", "± 12.0 ms"):
        assert text in shown
    await page.wait_text("joystick: its agent is of an earlier release")

    await page.click("Errors")
    await page.wait("document.querySelectorAll('.logline').length === 1")
    await page.click("All")
    await fill(page, "[aria-label=Module]", "base")
    await page.wait(f"{LINES}.length > 1 && {LINES}.every((each) => each.includes('base:/base'))")
    await fill(page, "[aria-label=Module]", "")
    await fill(page, "[aria-label^=Node]", "/rm*")
    await page.wait(f"{LINES}.length && {LINES}.every((each) => each.includes('velocity agent'))")
    await fill(page, '[aria-label="Filter by text"]', "no such text", "input")
    await page.wait_text("No line is like that")
    assert (site.server.reports, page.errors) == ([], [])


async def test_a_log_is_asked_for_while_it_is_shown_and_not_on_hold(site: Site) -> None:
    page = await site.open("log")
    await page.wait(f"{LINES}.length > 3")
    await page.click("Hold")
    await page.wait("[...document.querySelectorAll('button')].some((each) => each.textContent.trim() === 'Go on')")
    asked = len(site.server.asked)
    site.server.logs["base"].add("/late", 2, time.time_ns(), b"said meanwhile")
    await page.run("new Promise((done) => setTimeout(done, 1500))")  # longer than a question's period
    assert [each.what for each in site.server.asked[asked:]].count("log") == 0
    await page.click("Go on")
    await page.wait_text("said meanwhile")
    await page.run("location.hash = '#/topics'")
    await page.wait_text("/velocity_order")
    asked = len(site.server.asked)
    await page.run("new Promise((done) => setTimeout(done, 1500))")
    assert "log" not in [each.what for each in site.server.asked[asked:]], "no page shows it"


async def test_a_node_shows_its_own_lines_and_its_level_is_set(site: Site) -> None:
    site.server.logs["base"].add("/other", 8, time.time_ns(), b"of somebody else")
    site.server.rights = Rights(control=True)
    page = await site.open("node/base%3A%2Fbase")
    await page.wait(f"{LINES}.length > 1 && !{LINES}.some((each) => each.includes('somebody'))")
    await fill(page, "form.row select", "debug")
    await page.click("Set")
    await page.wait_text("rosout and ros: debug")
    (order,) = [each.args for each in site.server.asked if each.what == "set_log_level"]
    assert order == {"name": "/base", "peer": "base", "logger": "", "level": "debug"}
    assert "log_levels" not in [each.what for each in site.server.asked]  # some roscpp nodes do not outlive it
    await page.click("Show its loggers")
    await page.wait_text("rospy.core")


async def test_topics_that_carry_data_come_first_and_the_filter_looks_among_all(site: Site) -> None:
    page = await site.open("topics")
    await page.wait_text("are left out")
    rows = "[...document.querySelectorAll('tbody th')].map((each) => each.innerText.trim())"
    assert await page.run(rows) == ["/command_information", "/diagnostics", "/odom", "/velocity_order"]
    await page.run("(() => { const field = document.querySelector('main input'); field.value = 'base/qual';"
                   " field.dispatchEvent(new Event('input', {bubbles: true})); })()")  # fmt: skip
    await page.wait(f"{rows}.join() === '/base/quality'")
    page = await site.open("module/base")
    await page.wait("document.querySelector('details')")
    assert "/base/quality" not in await page.run("document.querySelector('main').innerText")


FIELD = "document.querySelector('form.edit input')"


async def edit(page: Chromium, text: str) -> None:
    """Put a text in place of all that the field has which is edited, and press Enter."""
    await page.wait(FIELD)
    await page.run(
        f"{FIELD}.value = {json.dumps(text)}; {FIELD}.dispatchEvent(new Event('input', {{bubbles: true}}))"
    )
    await page.run(f"{FIELD}.form.requestSubmit()")


async def test_the_search_finds_nodes_parameters_and_resources(site: Site) -> None:
    page = await site.open()
    for words, kind, address in (
        ("node base", "node", "#/node/base%3A%2Fbase"),
        ("wheel", "parameter", "#/params/%2Fbase%2Fwheel%2Fradius"),
        ("smart vel", "resource", "#/resource/velocity%3A%2Fvelocity"),
    ):
        await page.press("/")
        await page.wait("document.activeElement.type === 'search'")
        for key in words:
            await page.press(key)
        await page.wait(f"document.querySelector('.found [aria-selected=true] .kind')?.textContent === '{kind}'")
        await page.press("Enter")
        await page.wait(f"location.hash === '{address}' && document.activeElement.matches('main h1')")


@pytest.mark.parametrize(
    ("address", "scene", "text"),
    [
        ("module/joystick", "demo", "not reported by this peer"),  # whose agent is of an earlier release
        ("module/velocity", "sick", "no connection"),  # one of its lanes has none
        ("topics", "cut", "18,000 more topics are not listed: rmpa topic list"),
        ("topic/%2Fvelocity_order", "demo", "rule 1: topics /velocity"),  # its contract, before it has a route
        ("topic/%2Fodom", "demo", "the defaults apply"),
    ],
)
async def test_what_is_missing_and_what_holds_is_said(site: Site, address: str, scene: str, text: str) -> None:
    page = await site.open(address, scene)
    await page.wait_text(text)


async def test_a_service_is_called(site: Site) -> None:
    page = await site.open("service/base%3A%2Fbase%2Fset_parameters")
    await page.click("Call it")
    await page.wait_text("as asked")
    asked = {"service": "/base/set_parameters", "peer": "base", "request": {"data": False}}
    assert site.server.asked[-1].args == asked


async def change(page: Chromium, name: str) -> None:
    """Press the button that edits a value."""
    found = f"each.ariaLabel.startsWith({f'Change {name}'!r})"
    button = f"[...document.querySelectorAll('button.field')].find((each) => {found})"
    await page.wait(f"{button}?.click() ?? !!{button}")


async def test_what_is_no_value_of_a_setting_is_not_sent_and_the_draft_stays(site: Site) -> None:
    page = await site.open("resource/base%3A%2Fbase")
    await change(page, "rate")
    for typed, said in (
        ("", "Type a number"),
        ("0,4", "write it as 0.4"),
        ("fast", "not a number"),
        ("500", "not within 1 … 100"),
    ):
        await edit(page, typed)
        await page.wait_text(said)
        assert await page.run(f"{FIELD}.value") == typed
    assert "configure" not in [each.what for each in site.server.asked]
    await edit(page, "40")
    await page.wait_text("rate is 40 now")  # as the server says it
    assert site.server.asked[-1].args == {"resource": "/base", "peer": "base", "name": "rate", "value": 40}


async def test_each_edit_has_the_cursor_and_escape_gives_it_back(site: Site) -> None:
    page = await site.open("params")
    for name in ("/rosdistro", "/use_sim_time", "/rosdistro"):
        await change(page, name)
        await page.wait(f"{FIELD} && document.activeElement === {FIELD}")
        await page.press("Escape")
        await page.wait(f"!{FIELD} && document.activeElement.ariaLabel.startsWith('Change {name}')")


async def test_a_parameter_keeps_its_type(site: Site) -> None:
    page = await site.open("params")
    await page.click("false")
    for typed in ("1", "on", ""):
        await edit(page, typed)
        await page.wait(f"document.querySelector('form.edit .failure') && {FIELD}.value === {typed!r}")
    await edit(page, "True")
    await page.wait(f"!{FIELD}")
    assert [each.args["value"] for each in site.server.asked if each.what == "set_param"] == [True]


async def test_a_lost_connection_keeps_values_edits_and_rights(site: Site) -> None:
    page = await site.open("params")
    await page.click('"noetic"')
    await page.wait(FIELD)
    await page.run("window.Real = WebSocket; window.WebSocket = function () { return { close() {} }; }; rmpa.drop()")
    await page.wait_text("No connection to rmpa web")
    await edit(page, "half")
    await page.wait_text("Nothing was sent")
    text = await page.run("document.body.innerText")
    assert "wheel" in text
    assert "read-only" not in text
    await page.run("window.WebSocket = window.Real; rmpa.retry()")
    await page.wait("!document.querySelector('.banner')")
    site.server.params["/fresh"] = "come"
    await page.wait_text("come")
    assert await page.run(f"{FIELD}.value") == "half", "whatever other parameters do"
    await edit(page, "melodic")
    await page.wait_text('"melodic"')


async def test_the_heading_of_another_page_has_the_focus_and_a_dialog_gives_it_back(site: Site) -> None:
    page = await site.open()
    for key in "gt":  # its script is not loaded yet
        await page.press(key)
    await page.wait("document.activeElement.tagName === 'H1' && document.activeElement.textContent === 'Topics'")
    await page.run("document.querySelector('[aria-label^=Search]').focus()")
    for ends in ("Escape", "Enter"):
        await page.press("/")
        await page.wait("document.activeElement.type === 'search'")
        await page.press("Escape")
        await page.wait("!document.querySelector('dialog')")
        assert await page.run("document.activeElement.ariaLabel") == "Search (/)", ends


@pytest.mark.parametrize(
    "source",
    [
        "Object.defineProperty(document, 'hidden', {get: () => true})",
        "window.requestAnimationFrame = () => 0",  # it was hidden when it had asked for a frame
    ],
)
async def test_a_page_that_is_opened_in_the_background_is_whole(site: Site, source: str) -> None:
    await site.page.send("Page.addScriptToEvaluateOnNewDocument", source=source)
    page = await site.open("topic/%2Fodom")
    await page.wait_text("No rule of [[contract]] matches it")


async def test_a_page_says_that_its_connection_is_not_answered_and_is_there_when_it_is(site: Site) -> None:
    site.server.hears.clear()
    clock = "window.later = 0; const now = Date.now; Date.now = () => now() + window.later"
    await site.page.send("Page.addScriptToEvaluateOnNewDocument", source=clock)
    await site.page.goto(f"http://127.0.0.1:{site.port}/")
    await site.page.wait_text("Connecting")
    await site.page.run("window.later = 8000")
    await site.page.wait_text("No connection to rmpa web")
    site.server.hears.set()
    await site.page.wait("document.querySelector('h1') && !document.querySelector('.banner')")


async def test_long_lists_are_drawn_in_parts(site: Site) -> None:
    page = await site.open("module/base")
    topics = {f"/many/t{number:04}": {"type": "a/B", "from": ["base"], "to": []} for number in range(1952)}
    await receive(page, {"topics": topics})
    rows = "[...document.querySelectorAll('tbody th')].filter((each) => each.textContent.startsWith('/many/')).length"
    await page.wait(f"{rows} > 100")
    assert await page.run(rows) <= 200
    await page.click("Show 200 more of 1,754")
    await page.wait(f"{rows} > 390")


async def test_characters_that_turn_or_hide_a_name_are_seen(site: Site) -> None:
    page = await site.open("topics")
    evil = "/a\u202egpj.elif\u200b\x07"
    await receive(page, {"topics": {evil: {"type": "a/B", "from": [], "to": []}}})
    await page.wait_text("/a\\u202egpj.elif\\u200b\\u0007")
    assert await page.run("/[\u202e\u200b\x07]/.test(document.body.textContent)") is False
    await page.run("[...document.querySelectorAll('th a')].find((each) => each.textContent.includes('gpj')).click()")
    await page.wait("document.querySelector('h1').textContent.includes('u202e') && document.title.includes('u202e')")
    assert await page.run(f"decodeURIComponent(location.hash) === {json.dumps('#/topic/' + evil)}") is True


async def test_the_gravest_stands_first_and_a_lost_module_above_what_follows_from_it(site: Site) -> None:
    page = await site.open("", "killed")
    await page.wait("document.querySelector('.module.away')")
    problem = {"type": "a/B", "problem": "its peer is away"}
    alarm = {"level": "ERROR", "text": "hot", "resource": "velocity:/velocity", "module": "velocity", "at": 1.0}
    await receive(page, {"topics": {"/a": problem, "/b": problem}, "alarms": {"x": alarm}})
    whose = "[...document.querySelectorAll('.concerns strong')].map((each) => each.textContent)"
    await page.wait(f"{whose}.length === 3")
    assert await page.run(whose) == ["velocity:/velocity", "base", "2 topics"]


async def test_who_may_only_look_sees_no_way_to_change_anything(site: Site) -> None:
    site.server.rights = Rights(view=True)
    page = await site.open("params")
    await page.wait_text("noetic")
    assert await page.run("document.querySelectorAll('main button.field, main button.primary').length") == 0
    assert "Drive" not in await page.run("document.querySelector('nav').innerText")
    page = await site.open("drive")
    assert await page.run("document.querySelector('input[type=checkbox]').disabled") is True


# The modules that are not of this mesh.
OUTSIDE = "[...document.querySelectorAll('.outside li')]"


async def test_a_pending_module_is_invited_by_a_button_that_shows_the_line_once(site: Site) -> None:
    await site.page.look(360, 740)
    page = await site.open("", "knock")
    await page.wait(f"{OUTSIDE}.length === 3")
    assert await page.run(f"{OUTSIDE}.map((each) => each.querySelector('.mark').textContent)") == [
        "pending", "foreign", "revoked"
    ]  # fmt: skip
    assert await page.run(f"{OUTSIDE}.map((each) => each.querySelectorAll('button').length)") == [1, 0, 0]
    await page.click("Invite arm")
    await page.wait_text("rmpa trust join rmpa1-forarm")
    assert "A new one for arm replaces it." in await page.run("document.querySelector('.outside').innerText")
    assert site.server.asked[-1].args == {"name": "arm"}
    assert "rmpa1-" not in await page.run("JSON.stringify(window.rmpa.state) + location + document.cookie")
    assert await page.run(WIDTH) == 360
    assert await violations(page) == []
    await page.run("location.hash = '#/topics'")
    await page.wait_text("/velocity_order")
    await page.run("location.hash = '#/'")
    await page.wait(f"{OUTSIDE}.length === 3")
    assert await page.run("document.querySelector('.token')") is None
    site.server.agent.scene = "demo"  # it has joined, or has gone
    await page.wait("!document.querySelector('.outside')")


async def test_the_line_alone_is_shown_where_the_page_may_not_invite(site: Site) -> None:
    site.server.rights = Rights(view=True)
    page = await site.open("", "knock")
    await page.wait_text("run here: rmpa trust invite --module arm")
    assert await page.run("document.querySelectorAll('.outside button').length") == 0


async def test_a_page_whose_scripts_did_not_all_come_is_loaded_again(site: Site) -> None:
    await site.page.send("Network.enable")
    await site.page.send("Network.setBlockedURLs", urls=["*/parts.js"])
    await site.page.goto(f"http://127.0.0.1:{site.port}/")
    await site.page.wait("performance.getEntriesByName(new URL('static/again.js', location.href)).length")
    await site.page.send("Network.setBlockedURLs", urls=[])
    await site.page.wait("performance.getEntriesByType('navigation')[0].type === 'reload' && window.rmpa?.state")
