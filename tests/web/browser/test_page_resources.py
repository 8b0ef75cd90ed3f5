"""The page of a resource that is described by a file, in a real Chromium; the editor of that file; start and stop."""

from __future__ import annotations

import pytest

from rmpa.web.hub.node_link import Rights
from tests.web.browser.conftest import Site
from tests.web.browser.test_pages import SMALL, WIDTH, violations
from tests.web.monitor.wrapped import EXAMPLE, FILE

CAMERA = "resource/%2Fcamera"
LABELS = "[...document.querySelectorAll('.timeline svg[role=img]')].map((each) => each.ariaLabel)"
SPELL = "document.querySelector('.timeline [role=status]').innerText"
AREA = "document.querySelector('.editor textarea')"


async def test_what_a_resource_did_and_why_is_drawn_and_told(site: Site) -> None:
    page = await site.open(CAMERA, "wrapped")
    await page.wait(f"{LABELS}.some((each) => /[1-9][0-9]+ of [0-9]+ windows fell short/.test(each))")
    strip, rate, latency = await page.run(LABELS)
    assert [each.split()[0] for each in strip.partition(": ")[2].split("; ")] == [
        "full", "small", "full", "compressed", "full"
    ]  # fmt: skip
    assert "wanted at least 20 Hz" in rate
    assert latency.endswith(" 0 of " + latency.rpartition(" 0 of ")[2])
    assert "full offers more than compressed" in await page.run(SPELL)
    # A touch where the second one was: 503 to 383 s ago.
    await page.run(
        "((strip) => { const box = strip.getBoundingClientRect(); strip.dispatchEvent(new MouseEvent('click',"
        " {clientX: box.left + box.width * 0.27, bubbles: true})); })(document.querySelector('.spells'))"
    )
    await page.wait(f"{SPELL}.includes('latency 0.31 s instead of at most 0.2 s (the change took 210')")
    decisions = "[...document.querySelectorAll('.decisions summary')]"
    assert "compressed → full" in await page.run(f"{decisions}[0].innerText.replace(/\\s+/g, ' ')")
    await page.wait_text("The scores now")
    await page.run(f"{decisions}[1].click()")
    await page.wait_text("this page was not open then")
    text = await page.run("document.body.innerText.replace(/\\s+/g, ' ')")
    for said in ("rate 28.7 ± 1.1 Hz (312)", "rate 30 Hz", "turned by hand", "driver dynamic frame_rate", "4711"):
        assert said in text
    assert await violations(page) == []
    await page.look(360, 740, dark=False)
    assert await violations(page) == []
    assert (await page.run(WIDTH), await page.run(SMALL)) == (360, [])
    assert (site.server.reports, page.errors) == ([], [])


async def test_a_file_is_edited_its_error_told_at_its_line_and_saved_with_the_old_one_kept(site: Site) -> None:
    page = await site.open(f"file/{FILE}", "wrapped")
    await page.wait(AREA)
    before = EXAMPLE.read_text()
    assert await page.run(f"{AREA}.value") == before
    written = (
        "((area, text) => { area.value = text; area.dispatchEvent(new Event('input', {bubbles: true})); })"
        f"({AREA}, {AREA}.value.replace(%r, %r))"
    )
    await page.run(written % ("cost = 4", "cots = 4"))
    await page.click("Save")
    await page.wait("document.querySelector('.gutter .wrong')?.textContent === '23'")
    assert "did you mean profile.full.cost" in await page.run("document.querySelector('.failure').innerText")
    await page.click("line 23")
    await page.wait(f"{AREA}.value.slice({AREA}.selectionStart, {AREA}.selectionEnd) === 'cots = 4'")
    assert await violations(page) == []
    # What is typed stays while other pages are shown.
    await page.run("location.hash = '#/resources'")
    await page.wait_text("What modules can start")
    await page.run("history.back()")
    await page.wait(f"{AREA}?.value.includes('cots')")
    await page.run(written % ("cots = 4", "cost = 2"))
    await page.run(written % ('"image_publisher image_publisher"', '"image_publisher sh"'))
    await page.click("Save")
    await page.wait_text("how nodes are started is changed in the module's own files only")
    await page.run(written % ('"image_publisher sh"', '"image_publisher image_publisher"'))
    await page.look(360, 740, dark=False)
    assert (await page.run(WIDTH), await page.run(SMALL)) == (360, [])
    await page.click("Save")
    await page.wait_text(f"The text before is in {FILE}.bak")
    assert (site.server.folder / FILE).read_text() == before.replace("cost = 4", "cost = 2")
    assert (site.server.folder / f"{FILE}.bak").read_text() == before
    await page.click("Restart camera")
    await page.wait_text("camera starts again")
    assert site.server.asked[-1].args == {"do": "restart", "name": "camera"}
    assert (site.server.reports, page.errors) == ([], [])


@pytest.mark.long
async def test_resources_of_all_modules_are_started_and_a_refusal_says_whose_and_why(site: Site) -> None:
    page = await site.open("resources", "wrapped")
    await page.wait_text("cannot open /dev/ttyUSB0")
    await page.wait_text("joystick: its agent is of an earlier release")
    press = "[...document.querySelectorAll('main button')].find((each) => each.ariaLabel === '%s').click()"
    await page.run(press % "Start base")
    await page.wait_text("pc may not launch base")
    await page.run(press % "Log camera")
    await page.wait_text("driver: [WARN] unknown control 'focus_auto'")
    assert await violations(page) == []
    site.server.rights = Rights(view=True)
    page = await site.open(f"file/{FILE}", "wrapped")
    await page.wait_text("This page may only look")
    page = await site.open("resources", "wrapped")
    await page.wait_text("cannot open /dev/ttyUSB0")
    assert await page.run("document.querySelectorAll('main table button:not(.sort)').length") == 0


@pytest.mark.long
async def test_top_is_sorted_and_asked_only_while_it_is_shown(site: Site) -> None:
    page = await site.open("top", "wrapped")
    first = "document.querySelector('tbody th').innerText"
    await page.wait(f"{first} === '/tracker'")
    await page.run(
        "[...document.querySelectorAll('thead button')].find((each) => /Memory/.test(each.textContent)).click()"
    )
    await page.wait("document.querySelector('th[aria-sort=descending]')")
    await page.run(
        "[...document.querySelectorAll('thead button')].find((each) => /Memory/.test(each.textContent)).click()"
    )
    await page.wait(f"{first} === '/laser_filter'")
    await page.wait_text("joystick: its agent is of an earlier release")
    assert await violations(page) == []
    asked = site.server.asked
    await page.run("location.hash = '#/topics'")
    await page.wait_text("/velocity_order")
    asked.clear()
    # Two ticks take longer than its period.
    await page.run("window.ticks = 0; window.rmpa.tick = () => (window.ticks += 1)")
    await page.wait("window.ticks >= 2")
    assert not [each for each in asked if each.what in ("top", "launches")]
