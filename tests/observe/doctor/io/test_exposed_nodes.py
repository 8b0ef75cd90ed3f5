"""The ports of real processes at a real core."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from rmpa.observe.doctor.checks import exposed_nodes
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.http.rpc import call_api

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

NODE = """
import json, socket, sys
made = [socket.create_server((address, 0)) for address in sys.argv[1:]]
print(json.dumps([each.getsockname()[1] for each in made]), flush=True)
sys.stdin.read()
"""


@pytest.fixture
async def core() -> AsyncIterator[RosCore]:
    core = RosCore("127.0.0.1", 0)
    await core.start()
    yield core
    await core.close()


def node(*addresses: str) -> subprocess.Popen[str]:
    """A process with a socket at each address: the first is its slave API."""
    command = [sys.executable, "-c", NODE, *addresses]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


async def test_the_other_ports_of_a_nodes_process_are_found_too(core: RosCore) -> None:
    with (
        node("127.0.0.1", "0.0.0.0") as half_open,
        node("127.0.0.1") as closed,
        node("127.0.0.1", "0.0.0.0") as web,  # its other port asks for a token
    ):
        ports = {}
        for name, process in (("/half", half_open), ("/closed", closed), ("/rmpa_web", web)):
            assert process.stdout is not None
            ports[name] = json.loads(await asyncio.to_thread(process.stdout.readline))
            uri = f"http://127.0.0.1:{ports[name][0]}/"
            await call_api(core.uri, "registerPublisher", name, "/t", "std_msgs/String", uri)
        found = await asyncio.to_thread(exposed_nodes, core.uri, os.getpid())
        assert found == {"/half": (ports["/half"][1],)}
        assert await asyncio.to_thread(exposed_nodes, core.uri, half_open.pid) == {}
        for process in (half_open, closed, web):
            process.communicate()


async def test_a_core_that_does_not_answer_is_not_judged() -> None:
    assert await asyncio.to_thread(exposed_nodes, "http://127.0.0.1:1/", 1) is None
