"""The pages of recordings in a real Chromium: the list, what is kept, a story, its files, and its end."""

from __future__ import annotations

import os

from tests.web.browser.conftest import Site
from tests.web.browser.test_pages import SMALL, WIDTH, violations
from tests.web.monitor.recorded import ALARM, FELL

ROWS = "document.querySelector('table').innerText.replace(/\\s+/g, ' ')"


async def test_a_recording_is_kept_told_downloaded_and_removed(site: Site) -> None:
    page = await site.open("recordings")
    await page.wait_text("it fell over at the table")
    assert await page.run(f"/it fell over at the table [0-9:]+ pc, base 39.6 MB/.test({ROWS})")
    await page.wait_text("the disk is full: nothing is recorded")
    await page.run(
        "((field) => { field.value = 'hit'; field.dispatchEvent(new Event('input', {bubbles: true})); })"
        "(document.querySelector('main form input'))"
    )
    await page.click("Keep the last minutes")
    await page.wait_text("2 of 3 modules keep it.")
    await page.wait_text("joystick: its agent is of an earlier release")
    assert [one.args for one in site.server.asked if one.what == "keep_recording"] == [{"why": "hit"}]
    assert await violations(page) == []

    os.mkfifo(site.server.recordings.folder / "gate")
    await page.run(f"location.hash = '#/recording/{FELL}'")
    await page.wait_text("3.00\u2009MB of 39.6\u2009MB")
    (site.server.recordings.folder / "gate").write_bytes(b"")
    await page.wait_text("<b>motor 2 has no current</b>")
    links = "[...document.querySelectorAll('tbody a')].map((each) => each.getAttribute('href'))"
    assert {"#/module/base", "#/topic/%2Fodom"} <= {*await page.run(links)}
    # A press at 31.5 s of 60, in the first row.
    await page.run(
        "((drawing) => { const box = drawing.getBoundingClientRect(); drawing.dispatchEvent(new MouseEvent('click',"
        " {clientX: box.left + box.width * 0.525, clientY: box.top + 9, bubbles: true})); })"
        "(document.querySelector('.spells'))"
    )
    await page.wait("document.querySelector('tr.picked')?.innerText.includes('silent for 1.42 s')")
    assert await violations(page) == []
    await page.look(390, 740, dark=False)
    assert (await page.run(WIDTH), await page.run(SMALL)) == (390, [])
    await page.run("HTMLAnchorElement.prototype.click = function () { window.saved = this.href; }")
    await page.click("Download .bag")
    await page.wait("window.saved?.endsWith('/recording/" + FELL + ".bag')")
    assert await page.run("fetch(window.saved).then((got) => got.text())") == "made"
    await page.click("Remove")
    await page.click("Yes, remove it everywhere")
    await page.wait_text("It is removed.")
    await page.run("location.hash = '#/recordings'")
    await page.wait(f"!{ROWS}.includes('{FELL}') && {ROWS}.includes('{ALARM}')")
    await page.run("location.hash = '#/recording/bad'")
    await page.wait_text("no module has a recording bad [unknown-name]")
    await page.wait_text("Try again")
    assert (site.server.reports, page.errors) == ([], [])
