"""``[params]``, ``[[param]]`` and ``[time]``: what they come to, and every mistake with its line."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import pytest

from rmpa.config import limits
from rmpa.config.read import Loaded, load_settings
from rmpa.config.rules import FollowRule, overlap, untouchable
from rmpa.config.settings import ParamSettings, TimeSettings
from rmpa.core.errors import ConfigError

if TYPE_CHECKING:
    from pathlib import Path

Load = Callable[..., Loaded]


@pytest.fixture
def load(tmp_path: Path) -> Load:
    def load(text: str, **environ: str) -> Loaded:
        (tmp_path / "rmpa.toml").write_text(text)
        return load_settings({}, environ, host_name="pad", cwd=tmp_path)

    return load


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
"""
    ).settings
    rules = (FollowRule("/robot_description", "base", "/base/robot_description"), FollowRule("/arm", "arm", "/arm"))
    assert settings.params == ParamSettings(("/open/**",), (), rules)
    assert settings.time == TimeSettings("simulator", share=True)
    assert list(map(str, rules)) == ["base:/robot_description as /base/robot_description", "arm:/arm"]


def test_variables(load: Load) -> None:
    environ = {"RMPA_REMOTE_GET": "/a;/b", "RMPA_REMOTE_SET": "/c", "RMPA_TIME_FOLLOW": "sim", "RMPA_TIME_SHARE": "1"}
    settings = load("", **environ).settings
    assert settings.params == ParamSettings(("/a", "/b"), ("/c",))
    assert settings.time == TimeSettings("sim", share=True)


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
        (
            BASE.replace("/a", "/use_sim_time"),
            "2: param.key: /use_sim_time cannot be followed: time is",
        ),
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
def test_a_mistake_is_told_with_its_line(load: Load, tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError) as info:
        load(text)
    assert str(info.value).removeprefix(f"{tmp_path}/rmpa.toml:").startswith(message), info.value


def test_too_many_rules(load: Load) -> None:
    rules = "".join(BASE.replace("/a", f"/a{n}") for n in range(limits.FOLLOWED_MAX + 1))
    with pytest.raises(ConfigError, match=f"{limits.FOLLOWED_MAX + 1} rules"):
        load(rules)


def test_names_that_touch_each_other() -> None:
    assert overlap("/a", "/a")
    assert overlap("/a/", "/a/b")
    assert overlap("/a/b/c", "/a")
    assert overlap("/", "/a")
    assert not overlap("/a", "/ab")
    for key in ("/run_id", "/roslaunch", "/roslaunch/uris/x", "/use_sim_time", "/use_sim_time/", "/rosdistro", "/"):
        assert untouchable(key), key
    assert not untouchable("/run_ids")
