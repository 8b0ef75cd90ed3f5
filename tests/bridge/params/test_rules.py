"""What peers may do with parameters, by name."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from rmpa.bridge.params.rules import follow_rules, key_problem, replaced, why_not_follow, why_not_get, why_not_set
from rmpa.config.rules import FollowRule
from rmpa.config.settings import ParamSettings, Settings, TimeSettings
from rmpa.ros.master.parameters import leaves

if TYPE_CHECKING:
    from rmpa.ros.wire.xmlrpc import XmlRpcValue

SETTINGS = Settings(
    params=ParamSettings(
        ("/open/**", "/followed/**"),
        ("/open/**", "/roslaunch/**", "/followed/**"),
        (FollowRule("/x", "arm", "/followed"),),
    )
)


@pytest.mark.parametrize(
    ("key", "get", "put", "follow"),
    [
        ("/open/a", "", "", ""),
        ("/open", "", "", ""),
        ("/opened", "remote_get", "remote_set", "remote_get"),
        ("/", "remote_get", "the root", "the root"),
        ("/roslaunch/uris", "remote_get", "roslaunch's own", "remote_get"),
        ("/run_id", "remote_get", "names the run", "remote_get"),
        ("/use_sim_time", "remote_get", "[time] alone", "does not share"),
        ("/followed", "", "followed from arm:/x", "followed from arm:/x"),
        ("/followed/deep", "", "followed from arm:/x", "followed from arm:/x"),
    ],
)
def test_policy(key: str, get: str, put: str, follow: str) -> None:
    for why, expected in (
        (why_not_get(SETTINGS, key), get),
        (why_not_set(SETTINGS, key), put),
        (why_not_follow(SETTINGS, key), follow),
    ):
        assert (expected in why) if expected else why == ""


def test_time_is_followed_where_it_is_shared() -> None:
    shared = Settings(params=ParamSettings(remote_get=()), time=TimeSettings(share=True))
    assert why_not_follow(shared, "/use_sim_time") == ""
    chained = Settings(time=TimeSettings("sim", share=True))
    assert "time comes from sim here" in why_not_follow(chained, "/use_sim_time")
    rules = follow_rules(chained)
    assert rules == (FollowRule("/use_sim_time", "sim", "/use_sim_time"),)


@pytest.mark.parametrize("key", ["/a", "/joint-1/x.y", "/", "/a/b/"])
def test_names_that_masters_take(key: str) -> None:
    assert key_problem(key) == ""


@pytest.mark.parametrize("key", ["", "a", "~a", 1, None, "/a//b", "/a b", "/a\n", "/" + "a" * 2000, "/a" * 100])
def test_names_that_are_none(key: object) -> None:
    assert key_problem(key)


def test_leaves() -> None:
    value: XmlRpcValue = {"a": 1, "b": {"c": [1], "d": {}}, "e": {"f": "x"}}
    root: XmlRpcValue = {"a": 1}
    assert list(leaves("/x", value)) == [("/x/a", 1), ("/x/b/c", [1]), ("/x/e/f", "x")]
    assert list(leaves("/", root)) == [("/a", 1)]
    assert list(leaves("/x", 5)) == [("/x", 5)]


@pytest.mark.parametrize(
    ("names", "at", "present", "lost"),
    [
        (["/a/b"], "/a", {"b": 1}, []),
        (["/a/b"], "/a", {"b": {"x": 1, "y": {"z": 2}}}, ["/a/b/x", "/a/b/y/z"]),
        (["/a/b/c"], "/a", {"b": 7, "d": 8}, ["/a/b"]),
        (["/a/b"], "/a", 7, ["/a"]),
        (["/a"], "/a", {"b": 1}, ["/a/b"]),
        (["/a/new/x"], "/a", {"b": 1}, []),
        (["/x/y", "/b"], "/", {"x": 1, "b": {"c": 2}}, ["/x", "/b/c"]),
        (["/a"], "/a", None, []),
    ],
)
def test_what_is_lost_when_a_value_takes_the_place_of_a_namespace_or_the_other_way_round(
    names: list[str], at: str, present: XmlRpcValue, lost: list[str]
) -> None:
    assert list(replaced(names, at, present)) == lost
