"""The page Drive in a real Chromium: keys, a gamepad and its dead man's button, who drives what, what stops it."""

from __future__ import annotations

import json

import pytest

from lab.bed.chromium import Chromium
from rmpa.web.hub.node_link import Rights
from rmpa.web.monitor import limits
from tests.waiting import until
from tests.web.browser.conftest import Site

TICK = "document.querySelector('input[type=checkbox]')"
STICK = "document.querySelector('.stick')"
FASTEST = 0.15 * limits.DRIVE_SPEED  # as the page has it at first


async def taken(site: Site) -> Chromium:
    """The page, opened anew, with the stick."""
    page = await site.open("drive")
    await page.run("window.before = true")
    await page.send("Page.reload")
    await page.wait("!window.before && window.rmpa?.stick")
    await page.run(f"{TICK}.click()")
    await page.wait(f"!{STICK}.classList.contains('off')")
    return page


async def test_a_robot_moves_only_while_the_stick_is_held(site: Site) -> None:
    page = await site.open("drive")
    await page.run(f"{STICK}.focus()")
    await page.press("ArrowUp")
    assert site.server.speeds == []  # it is not armed yet
    await page.run(f"{TICK}.click()")
    await page.wait(f"!{STICK}.classList.contains('off')")
    await page.run(f"{STICK}.focus()")
    await page.down("ArrowUp")
    await page.wait("document.querySelector('.stick + p').textContent.includes('forward 60 %')")
    await until(lambda: len(site.server.speeds) > 3)
    await page.wait_text("commanded: 0.18 m/s")
    await page.up("ArrowUp")
    await page.wait("document.querySelector('.stick + p').textContent.includes('forward 0 %')")
    await page.wait("window.rmpa.socket.bufferedAmount === 0")
    await until(lambda: site.server.speeds[-1].linear == 0)
    speeds = [each.linear for each in site.server.speeds]
    assert speeds[0] == 0  # one command alone moves nothing
    assert 0 < speeds[1] < max(speeds) == pytest.approx(0.6 * FASTEST)  # a ramp


async def test_the_warning_of_late_commands_ends_with_the_hold(site: Site) -> None:
    page = await site.open("drive")
    await page.wait("window.rmpa.stick")
    await page.run("document.querySelector('input[type=checkbox]').click()")
    await page.wait("!document.querySelector('.stick').classList.contains('off')")
    await page.run("window.rmpa.serverTime = () => -1000")
    await page.run("document.querySelector('.stick').focus()")
    await page.down("ArrowUp")
    await page.wait_text("late, and are dropped")
    await page.up("ArrowUp")
    await page.wait("!document.querySelector('.banner')")


# A gamepad of the test's own, which says that it has changed whenever the page looks at it.
GAMEPAD = """
window.pad = {id: 'Pad 9', index: 0, connected: true, mapping: '', timestamp: 1, axes: [0, 0, 0, 0],
  buttons: Array.from({length: 8}, () => ({pressed: false, value: 0}))};
window.press = (n, pressed) => { window.pad.buttons[n] = {pressed, value: Number(pressed)}; return true; };
window.still = 0;
Object.defineProperty(navigator, 'getGamepads', {value: () => {
  if (window.pad && !window.still) window.pad.timestamp++;
  return [window.pad];
}});
"""


# What ends a hold while the button is down.
STOPS = (
    "dispatchEvent(new Event('blur'))",
    "window.gone = window.pad, window.pad = null",
    (
        "Object.defineProperty(document, 'hidden', {get: () => true, configurable: true}), "
        "document.dispatchEvent(new Event('visibilitychange'))"
    ),
    "rmpa.drop()",
)


async def with_gamepad(site: Site) -> Chromium:
    await site.page.send("Page.addScriptToEvaluateOnNewDocument", source=GAMEPAD)
    return await taken(site)


async def drives(site: Site, page: Chromium, button: int = 4) -> None:
    """The button is pressed, and the robot drives at full speed."""
    await page.run(f"press({button}, true)")
    await until(lambda: site.server.speeds and site.server.speeds[-1].linear == pytest.approx(FASTEST))


async def stops(site: Site) -> None:
    await until(lambda: site.server.speeds[-1].linear == 0)


async def test_a_gamepad_drives_only_while_its_button_is_held(site: Site) -> None:
    page = await with_gamepad(site)
    await page.wait_text("nothing moves until then")
    await page.run("window.pad.axes = [0, -1, 0, 0]")
    await page.wait_text("-1.00")
    assert site.server.speeds == []
    await drives(site, page)
    await page.wait_text("it is held")
    await page.run("press(4, false)")
    await stops(site)
    for stopped in STOPS:
        await drives(site, page)
        await page.run(f"{stopped}; true")
        await stops(site)
        count = len(site.server.speeds)
        await page.run("window.pad ||= window.gone; delete document.hidden; true")
        await page.wait("new Promise((done) => setTimeout(() => done(true), 700))")  # the button is still down
        assert len(site.server.speeds) == count, stopped
        await page.run("press(4, false)")
        if "drop" not in stopped:
            await page.wait_text("nothing moves until then")


async def test_a_button_that_is_down_before_the_stick_is_taken_does_not_drive(site: Site) -> None:
    await site.page.send("Page.addScriptToEvaluateOnNewDocument", source=GAMEPAD + "window.press(4, true);")
    page = await taken(site)
    await page.run("window.pad.axes = [0, -1, 0, 0]")
    await page.wait_text("it is held")
    assert site.server.speeds == []
    await page.run("press(4, false)")
    await page.wait_text("nothing moves until then")
    await drives(site, page)


async def test_a_gamepad_that_does_not_change_any_more_stops_the_robot(site: Site) -> None:
    clock = "window.later = 0; const now = Date.now; Date.now = () => now() + window.later;"
    await site.page.send("Page.addScriptToEvaluateOnNewDocument", source=clock)
    page = await with_gamepad(site)
    await page.run("window.pad.axes = [0, -1, 0, 0]")
    await drives(site, page)
    await page.run("window.still = true, window.later = 11000, true")
    await stops(site)
    await page.wait_text("has not changed for 10 s")


async def test_the_mapping_is_chosen_by_moving_and_kept_in_the_browser(site: Site) -> None:
    page = await with_gamepad(site)
    await page.run("document.querySelector('details').open = true")
    await page.click("Choose")
    await page.run("press(7, true)")
    await page.wait_text("Dead man's button: 7")
    await page.run("press(7, false)")
    await page.run("document.querySelector('[aria-label=\"Choose Forwards\"]').click()")
    await page.run("window.pad.axes = [0, 0, 0.9, 0], true")
    await page.wait_text("Forwards: axis 2")
    await page.run("[...document.querySelectorAll('details input')][0].click()")  # reversed: downwards is forwards
    page = await taken(site)
    await page.run("window.pad.axes = [0, 0, 1, 0], true")
    await drives(site, page, 7)
    assert json.loads(await page.run("localStorage['rmpa.gamepads']"))["Pad 9"]["hold"] == 7
    await page.run("localStorage['rmpa.gamepads'] = JSON.stringify({'Pad 9': {hold: 'x', forward: 900}})")
    page = await taken(site)
    await page.wait_text("Hold button 4")
    assert page.errors == []


async def test_the_page_shows_who_drives_what_and_each_page_may_stop_it(site: Site) -> None:
    page = await site.open("drive")
    await page.wait_text("The stick is free")
    await page.wait("document.querySelector('.chain').innerText.includes('/safety_stop')")
    stick = site.server.sticks.show("/cmd_vel", "other", lambda _: None, drives=True)
    stick.take("other", "10.0.0.99")
    await page.wait_text("The page of 10.0.0.99")
    await page.press("Escape")
    await until(lambda: stick.holder is None)
    stick.take("other", "10.0.0.99")
    await page.click("Take over")
    await page.wait_text("This page")
    assert stick.holder != "other"
    stick.stop("10.0.0.99")
    await page.wait_text("does not obey this page any more")
    await page.wait(f"!{TICK}.checked")
    await page.run(f"{TICK}.click()")
    await page.wait_text("This page")
    await page.wait("!document.querySelector('.banner')")  # it obeys again


async def test_a_topic_is_driven_with_the_type_that_it_has(site: Site) -> None:
    page = await taken(site)
    field = "document.querySelector('input[list=driven]')"
    await page.run(f"{field}.value = '/car/drive', {field}.dispatchEvent(new Event('input', {{bubbles: true}}))")
    await page.wait("document.querySelector('select').value === 'ackermann_msgs/AckermannDrive'")
    await page.wait_text("Widest steering angle: 5°")
    assert await page.run("document.querySelector('select').disabled && !rmpa.stick?.mine") is True


async def test_who_may_not_drive_sees_who_does_and_may_stop_it(site: Site) -> None:
    site.server.rights = Rights(view=True)
    page = await site.open("drive")
    await page.wait_text("This page may not drive")
    assert await page.run(f"{TICK}.disabled") is True
    stick = site.server.sticks.show("/cmd_vel", "other", lambda _: None, drives=True)
    stick.take("other", "10.0.0.99")
    await page.wait_text("The page of 10.0.0.99")
    await page.click("Stop the robot")
    await until(lambda: stick.holder is None)
