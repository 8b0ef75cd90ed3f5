"""A hostile peer of direct transport: false endpoints lead nowhere, floods and storms are bounded."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import pytest

from lab.bed.processes import Process
from rmpa.bridge import limits
from rmpa.observe.control_client import ControlClient
from tests.interop.modules import flows
from tests.interop.ros import NODES
from tests.interop.transports import AUTO, on_the_network, wait_direct

if TYPE_CHECKING:
    from lab.bed.namespaces import Lab
    from tests.interop.conftest import ModuleFactory

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(240)]


def test_a_hostile_peer_leads_nobody_astray(modules: ModuleFactory, lab: Lab) -> None:
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    heard = b.ros.roscpp("listener", topic="/to_b")
    speaker = a.ros.roscpp("talker", "__name:=speaker", topic="/to_b", rate=100)
    wait_direct(heard, speaker)
    a.ros.roscpp("listener", "__name:=gullible", topic="/evil").wait_event("up")
    eve = lab.host("eve", 0)
    with ControlClient(a.agent.sockets()[0]) as client:
        guid = client.snapshot().agent.guid
    with Process(eve.command([sys.executable, NODES / "hostile_direct.py", eve.address, guid])) as attack:
        done = attack.wait_event("done", 200.0)
    assert done["relayed"] == 16, "each false endpoint leaves the subscriber relayed"
    assert int(str(done["many granted"])) <= limits.DIRECT_MAX
    assert int(str(done["many limit"])) > 0
    assert done["none offered"] == 3000
    assert int(str(done.get("at once granted", 0))) == 0
    assert done["bad error"] == 4
    assert done["lived"]
    assert int(str(done["asks"])) <= 8, "once a second, whatever it is told"
    assert done["ended"] == 5, "a malformed notification closes the link that it came by"
    report = flows(heard, 50)
    assert (report["bad"], report["gaps"], report["doubled"]) == (0, 0, 0)
    assert a.agent.process.returncode is None
    lines = a.agent.process.lines
    assert not [line for line in lines if "Traceback" in line or "\x1b" in line], "\n".join(lines[-40:])
