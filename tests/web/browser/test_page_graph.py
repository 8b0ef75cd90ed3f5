"""The graph of nodes and topics in a real Chromium: what is drawn, chosen, filtered, moved and saved."""

from __future__ import annotations

from tests.web.browser.conftest import Site
from tests.web.browser.test_pages import WIDTH, violations

IDS = "[...document.querySelectorAll('.vertex')].map((each) => each.dataset.id)"
VIEW = "document.querySelector('.graph').getAttribute('viewBox')"
NODE = "/rmpa/velocity/velocity"


async def test_the_graph_has_nodes_in_lanes_and_one_is_chosen_by_keys_alone(site: Site) -> None:
    page = await site.open("graph")
    await page.wait("document.querySelectorAll('.vertex.node').length >= 3")
    lanes = "[...document.querySelectorAll('.lane-name')].map((each) => each.textContent)"
    assert await page.run(lanes) == ["pc", "base", "joystick", "velocity"]
    assert "/velocity/state" not in str(await page.run(IDS))  # what a Smart Resource says of itself
    await page.run(f"[...document.querySelectorAll('.vertex')].find((each) => each.dataset.id === {NODE!r}).focus()")
    await page.press("Enter")
    await page.wait("document.querySelector('.vertex.chosen') && document.querySelector('.graph.dims .edge.lit')")
    await page.press("ArrowRight")
    assert await page.run("document.activeElement.dataset.id") == "topic /velocity_order"
    await page.click("Only it and its neighbours")
    await page.wait(f"{IDS}.length === 3")
    assert sorted(await page.run(IDS)) == ["/pc", NODE, "topic /velocity_order"]
    await page.run("document.querySelector('.beside-graph .panel + .panel a').click()")
    await page.wait("document.querySelector('h1').textContent === '/rmpa/velocity/velocity'")
    assert (site.server.reports, page.errors) == ([], [])


async def test_the_graph_is_filtered_and_debug_topics_are_shown_on_demand(site: Site) -> None:
    page = await site.open("graph")
    await page.wait("document.querySelector('.vertex')")
    await page.run("[...document.querySelectorAll('.check')].find((e) => e.innerText.includes('Debug')).click()")
    await page.wait(f"{IDS}.some((each) => each.includes('/rosout'))")
    await page.click("Nodes only")
    await page.wait(f"{IDS}.every((each) => !each.startsWith('topic '))")
    await page.click("Nodes and topics")
    await page.run("document.querySelector('.filter').focus()")
    for key in "velocity order".replace(" ", "_"):
        await page.press(key)
    await page.wait(f"{IDS}.length === 3")
    table = "[...document.querySelectorAll('tbody th')].map((each) => each.innerText)"
    assert await page.run(table) == ["/velocity_order"]
    await page.look(360, 740, dark=False)
    assert await violations(page) == []
    assert await page.run(WIDTH) == 360


async def test_the_view_is_moved_zoomed_and_saved(site: Site) -> None:
    page = await site.open("graph")
    await page.wait("document.querySelector('.vertex')")
    whole = await page.run(VIEW)
    await page.run("document.querySelector('.graph').focus()")
    for key in ("+", "ArrowLeft"):
        before = await page.run(VIEW)
        await page.press(key)
        await page.wait(f"{VIEW} !== {before!r}")
    await page.press("0")
    await page.wait(f"{VIEW} === {whole!r}")
    await page.run(
        "window.saved = []; URL.createObjectURL = (blob) => (blob.text().then((text) => window.saved.push(text)),"
        " 'blob:x'); HTMLAnchorElement.prototype.click = function () { window.saved.push(this.download); }; true"
    )
    await page.click("Save as SVG")
    await page.wait("window.saved.length === 2")
    file = await page.run(
        "(([text]) => { const root = new DOMParser().parseFromString(text, 'image/svg+xml').documentElement;"
        " return [root.tagName, root.querySelectorAll('a').length, root.querySelector('text').getAttribute('fill'),"
        " text.includes('velocity_order')]; })(window.saved.filter((each) => each !== 'graph.svg'))"
    )
    assert file[0] == "svg"
    assert file[1] == len(await page.run(IDS))
    assert file[2].startswith("rgb")
    assert file[3] is True
