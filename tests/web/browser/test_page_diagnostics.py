"""The page of diagnostics in a real Chromium, and what the page of the mesh says of them."""

from __future__ import annotations

from tests.web.browser.conftest import Site
from tests.web.browser.test_pages import WIDTH, violations

CONCERNS = "[...document.querySelectorAll('.concerns a')].map((each) => each.innerText.replace(/\\s+/g, ' '))"
CHOSEN = "document.querySelector('.beside-status.chosen > .panel')"
SAMPLES = f"{CHOSEN}.querySelector('.plot canvas') && document.querySelector('.plot').ariaLabel"


async def test_an_error_of_a_node_is_what_is_wrong_and_leads_to_its_status_with_a_plot(site: Site) -> None:
    page = await site.open("", "ill")
    await page.wait_text("arm_driver: Battery/Cell 1: too hot")
    first, second = await page.run(CONCERNS)
    assert first.startswith("base SN 4711 arm_driver: Battery/Cell 1: too hot")
    assert second.startswith("1 warning")  # the agent's own are said elsewhere on that page
    await page.run("document.querySelector('.concerns a').click()")
    await page.wait(f"{CHOSEN}?.innerText.includes('Voltage')")
    await page.run(
        f"[...{CHOSEN}.querySelectorAll('button')].find((each) => each.ariaLabel === 'Plot Voltage').click()"
    )
    await page.wait(SAMPLES)
    assert "Voltage 2" in await page.run(SAMPLES)
    plots = f"[...{CHOSEN}.querySelectorAll('button')].map((each) => each.ariaLabel)"
    assert await page.run(plots) == [
        "Plot Voltage",
        "Plot __proto__",
    ]  # neither an address nor what is NaN all the time
    assert await violations(page) == []
    await page.look(360, 740, dark=False)
    assert await violations(page) == []
    assert await page.run(WIDTH) == 360
    assert (site.server.reports, page.errors) == ([], [])


async def test_the_tree_is_of_module_hardware_and_name_and_keeps_filter_and_groups(site: Site) -> None:
    page = await site.open("diagnostics", "ill")
    await page.wait("document.querySelectorAll('.status').length === 5")
    groups = "[...document.querySelectorAll('.diagnostics summary strong')].map((each) => each.textContent)"
    assert await page.run(groups) == ["base", "SN 4711 / arm_driver / Battery", "pc"]
    await page.click("Warnings and worse")
    await page.wait("document.querySelectorAll('.status').length === 3")
    await page.run("document.querySelector('.status').click()")
    await page.wait(f"{CHOSEN}?.innerText.includes('Voltage')")
    assert await page.run("document.querySelectorAll('.status').length") == 3
    assert await page.run("document.querySelector('.status').ariaCurrent") == "true"
    await page.wait_text("<b>late</b>")
    strip = "document.querySelector('.status .strip').innerHTML"
    before = await page.run(strip)
    await page.run("Date.now = ((now) => () => now() + 60000)(Date.now); true")
    await page.wait(f"{strip} !== {before!r}")  # time passes, and no status changes


async def test_what_nodes_report_no_more_is_stale(site: Site) -> None:
    page = await site.open("diagnostics", "ill")
    await page.wait_text("too hot")
    site.server.reports_of_nodes.silent = True
    await page.wait(
        "[...document.querySelectorAll('.status')].some((each) => each.innerText.startsWith('stale (error)'))"
    )
    await page.run("location.hash = '#/'")
    await page.wait_text("too hot (nothing since)")


async def test_a_lost_link_is_red_and_says_what_stopped_until_it_is_back(site: Site) -> None:
    page = await site.open()
    await page.wait("document.querySelector('.wire.up')")
    site.server.agent.scene = "killed"
    await page.wait("document.querySelector('.wire.lost.bad') && document.querySelector('.module.lost.bad')")
    assert "Stopped: /odom (" in (await page.run(CONCERNS))[0]
    assert await violations(page) == []
    site.server.agent.scene = "demo"
    await page.wait("!document.querySelector('.wire.lost')")


async def test_services_show_the_types_that_their_servers_tell(site: Site) -> None:
    page = await site.open("services")
    await page.wait_text("dynamic_reconfigure/Reconfigure")
    await page.wait_text("not told by its server")
