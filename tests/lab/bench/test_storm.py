"""The storm's calls are ones that every master takes, ours and in the right order."""

from __future__ import annotations

import importlib.util
import sys
from typing import TYPE_CHECKING, Any

import pytest

from lab.bed.ros import NODES
from rmpa.ros.core.embedded import RosCore

if TYPE_CHECKING:
    from types import ModuleType


@pytest.fixture
def storm() -> ModuleType:
    """The node's file: it is a program and no module of a package."""
    spec = importlib.util.spec_from_file_location("storm_node", NODES / "storm.py")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


async def test_our_core_takes_every_call_of_the_mix(storm: ModuleType) -> None:
    core = RosCore("127.0.0.1", 0)
    await core.start()
    try:
        api = "http://127.0.0.1:9/"
        for number in range(storm.NODES):
            node = f"/storm/node{number}"
            core.call("registerSubscriber", node, f"/storm/topic{number}", "std_msgs/String", api)
            core.call("setParam", node, node, {"gain": 1.0})
        for number in range(3 * len(storm.MIX)):
            method = storm.MIX[number % len(storm.MIX)]
            arguments: tuple[Any, ...] = storm.arguments(method, number, api)
            reply = core.call(method, *arguments)
            assert reply.code == 1, f"{method}{arguments}: {reply}"
            if method == "unregisterSubscriber":
                assert reply.value == 1, "it had registered before"
    finally:
        await core.close()


def test_it_needs_nothing_but_the_standard_library(storm: ModuleType) -> None:
    roots = {name.partition(".")[0] for name in vars(storm) if name in sys.modules}
    assert roots <= set(sys.stdlib_module_names)
