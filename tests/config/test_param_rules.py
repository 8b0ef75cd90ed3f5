"""``[params]``, ``[[param]]`` and ``[time]``: what they come to, and every mistake with its line."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from rmpa.config import limits
from rmpa.config.rules import FollowRule, overlap, untouchable
from rmpa.config.settings import ParamSettings, TimeSettings

if TYPE_CHECKING:
    from tests.config.conftest import Load, Refuse


def test_all_of_it(load: Load) -> None:
    settings = load(
        """
[params]
remote_get = ["/open/**"]
remote_set = []
[time]
follow = "simulator"
share = true
[[param]]
key = "/robot_description"
from = "base"
to = "/base/robot_description"
[[param]]
key = "/arm/"
from = "arm"
""",
        host_name="pad",
    ).settings
    rules = (FollowRule("/robot_description", "base", "/base/robot_description"), FollowRule("/arm", "arm", "/arm"))
    assert settings.params == ParamSettings(("/open/**",), (), rules)
    assert settings.time == TimeSettings("simulator", share=True)
    assert list(map(str, rules)) == ["base:/robot_description as /base/robot_description", "arm:/arm"]


BASE = '[[param]]\nkey = "/a"\nfrom = "base"\n'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[[param]]\nkey = "/a"', "1: param: a rule without from"),
        ('[[param]]\nfrom = "base"', "1: param: a rule without key"),
        (BASE + 'too = "/b"', "4: param.too: an unknown key; did you mean param.to?"),
        (BASE.replace("/a", "a"), "2: param.key: 'a' is not a global name; did you mean \"/a\"?"),
        (BASE.replace("/a", "/a/*"), "2: param.key: '/a/*' is a glob"),
        (BASE.replace("/a", "/"), "2: param.key: the root holds every parameter"),
        (BASE.replace("/a", "/a b"), "2: param.key: '/a b' is not a parameter's name"),
        (BASE.replace("/a", "/" + "a" * 2000), "2: param.key: a name of 2001 characters"),
        (BASE.replace("base", "robot-1"), "3: param.from: 'robot-1' is not a ROS base name"),
        (BASE.replace("base", "hall/arm"), "3: param.from: 'hall/arm' is a module of another site"),
        (BASE.replace("base", "pad"), "3: param.from: pad is this module itself"),
        (BASE + 'to = "/run_id"', "4: param.to: /run_id cannot be followed: it names the run"),
        (BASE + 'to = "/roslaunch"', "4: param.to: /roslaunch cannot be followed"),
        (BASE.replace("/a", "/use_sim_time"), "2: param.key: /use_sim_time cannot be followed: time is"),
        (BASE + BASE, "4: param: /a cannot come from base too: /a comes from base's /a already; a parameter has one"),
        (
            BASE + BASE.replace("base", "arm").replace("/a", "/a/b"),
            "4: param: /a/b cannot come from arm too: /a comes",
        ),
        (BASE.replace("/a", "/a/b") + BASE + 'to = "/a"', "4: param: /a cannot come from base too: /a/b comes from"),
        ('[param]\nkey = "/a"', "1: param: one table, where a list of them is expected; write [[param]]"),
        (
            "[params]\nremote_get = ['a b']",
            "2: params.remote_get: 'a b' is not a glob over parameters; a parameter has",
        ),
        ("[params]\nremote_get = ['a']", "2: params.remote_get: 'a' matches no parameter"),
        ("[params]\nget = []", "2: params.get: an unknown key"),
        ("[time]\nfollow = 'pad'", "2: time.follow: pad is this module itself"),
        ("[time]\nfollow = 'a b'", "2: time.follow: 'a b' is not a ROS base name"),
        ("[time]\nshare = 'x'", "2: time.share: "),
    ],
)
def test_a_mistake_is_told_with_its_line(refuse: Refuse, text: str, message: str) -> None:
    assert refuse(text, host_name="pad").removeprefix("rmpa.toml:").startswith(message)


def test_too_many_rules(refuse: Refuse) -> None:
    rules = "".join(BASE.replace("/a", f"/a{n}") for n in range(limits.FOLLOWED_MAX + 1))
    assert f"{limits.FOLLOWED_MAX + 1} rules" in refuse(rules)


def test_names_that_touch_each_other() -> None:
    assert overlap("/a", "/a")
    assert overlap("/a/", "/a/b")
    assert overlap("/a/b/c", "/a")
    assert overlap("/", "/a")
    assert not overlap("/a", "/ab")
    for key in ("/run_id", "/roslaunch", "/roslaunch/uris/x", "/use_sim_time", "/use_sim_time/", "/rosdistro", "/"):
        assert untouchable(key), key
    assert not untouchable("/run_ids")
