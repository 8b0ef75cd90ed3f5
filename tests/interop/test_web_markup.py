"""What others write is text on the pages of ``rmpa web``: names, values, logs and descriptors that are markup."""

from __future__ import annotations

import asyncio
import json
from typing import Final
from urllib.parse import quote

import msgspec
import pytest

from lab.bed.chromium import Chromium
from lab.bed.namespaces import Lab
from rmpa.ros.types.descriptor import Descriptor, ParameterDescriptor, ProfileDescriptor
from tests.interop.conftest import ModuleFactory, WebFactory
from tests.interop.ros import PYTHON
from tests.interop.web import needs_browser

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(150)]

EVIL: Final = "<img src=x onerror=alert(1)>"
# A name that a master accepts: it has no space and no colon.
EVIL_NAME: Final = "/<img/src=x/onerror=alert(1)>"
LINK: Final = "javascript:alert(1)"
REGISTER: Final = """
import os, sys, xmlrpc.client
evil, name, link, here = sys.argv[1:]
master = xmlrpc.client.ServerProxy(os.environ["ROS_MASTER_URI"])
me = "/<svg/onload=alert(1)>"
for done in (
    master.registerPublisher(me, name, evil + "/x", here),
    master.registerSubscriber(me, name, evil + "/x", here),
    master.registerService(me, name + "/service", "rosrpc://127.0.0.1:9", here),
    master.setParam(me, name, evil),
    master.setParam(me, "/links", {evil: link, "here": [link, {link: evil}]}),
):
    assert done[0] == 1, done
"""
# Elements that none of the pages has by itself.
MARKUP: Final = "img[src=x], svg[onload], [onerror], b#owned, a[href^='javascript:' i], script:not([src])"


def evil_resource() -> str:
    """The descriptor of a Smart Resource whose every text is markup."""
    profile = ProfileDescriptor(name=EVIL, offers={EVIL: EVIL}, description=EVIL)
    parameter = ParameterDescriptor(name=EVIL, type=EVIL, default=LINK, unit=EVIL, description=LINK)
    made = Descriptor(
        name=EVIL,
        node=LINK,
        role=EVIL,
        physical=False,
        description=EVIL,
        profiles=(profile,),
        parameters=(parameter,),
    )
    return msgspec.json.encode(made).decode()


@needs_browser
async def test_names_and_values_of_others_are_shown_as_text(
    lab: Lab, modules: ModuleFactory, web: WebFactory
) -> None:
    base, arm = modules("base", "arm")
    served = web(base.agent, "--control")
    clerk, words, resource = tellers = [
        module.ros.rospy("text_teller", topic=topic, commands=True, latch=True)
        for module, topic in ((base, "/silent"), (arm, "/words"), (arm, "/evil/descriptor"))
    ]
    switch = arm.ros.rospy("switch", name="switch", fail=f"{EVIL} {LINK}")
    await asyncio.gather(*(node.expect_event("up") for node in (*tellers, switch)))
    (up,) = clerk.events("up")
    clerk.tell(json.dumps({"log": f"{EVIL} {LINK}"}))
    words.tell(json.dumps({"data": f"{EVIL} {LINK}"}))
    resource.tell(json.dumps({"data": evil_resource()}))
    await asyncio.to_thread(base.ros.tool, PYTHON, "-c", REGISTER, EVIL, EVIL_NAME, LINK, str(up["uri"]))
    async with Chromium(lab.host("tablet", 0)) as page:
        watch = (
            "document.addEventListener('securitypolicyviolation', (event) => console.error(event.violatedDirective))"
        )
        await page.send("Page.addScriptToEvaluateOnNewDocument", source=watch)
        await served.open(page)

        async def shows(address: str, title: str, *texts: str, click: str = "") -> None:
            await page.run(f"location.hash = {json.dumps('#/' + address)}")
            await page.wait(f"document.querySelector('h1').textContent === {json.dumps(title)}")
            if click:
                await page.click(click)
            for text in texts:
                await page.wait_text(text)
            assert await page.run(f"document.querySelectorAll({json.dumps(MARKUP)}).length") == 0, address

        await shows("topics", "Topics", EVIL_NAME, f"{EVIL}/x")
        await shows(f"topic/{quote(EVIL_NAME, safe='')}", EVIL_NAME, f"{EVIL}/x")
        await shows(f"topic/{quote(EVIL_NAME, safe='')}", EVIL_NAME, "is not a topic's name", click="On")
        await shows("topic/%2Fwords", "/words", f"{EVIL} {LINK}", click="On")
        await shows("services", "Services", f"{EVIL_NAME}/service")
        await shows("service/arm%3A%2Fswitch", "/switch", f"{EVIL} {LINK}", click="Call it")
        await shows("params", "Parameters", EVIL, f'"{LINK}"')
        await shows("resources", "Smart Resources", EVIL)
        await shows("resource/arm%3A%2Fevil", "/evil", EVIL, LINK)
        await shows("log", "Log", f"{EVIL} {LINK}")
        await shows("alarms", "Alarms", "All that is wrong")
        await shows("module/base", "base", EVIL_NAME)
        await shows("", "Mesh", "Modules")
        await page.press("/")
        await page.wait("document.activeElement.type === 'search'")
        await page.send("Input.insertText", text="<img")
        await page.wait("document.querySelector('.found')?.innerText.includes('<img/src=x')")
        assert await page.run(f"document.querySelectorAll({json.dumps(MARKUP)}).length") == 0
        assert page.errors == []
