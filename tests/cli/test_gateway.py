"""``rmpa gateway`` as a user types it: its settings, its errors, its help."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from rmpa.cli.gateway import load_gateway
from rmpa.config.settings import Settings
from tests.cli.conftest import Place

SITE = ("gateway", "--site", "warehouse")


def load(tmp_path: Path, text: str = "", options: dict[str, object] | None = None, **environ: str) -> Settings:
    (tmp_path / "rmpa.toml").write_text(text)
    given = {"config": str(tmp_path / "rmpa.toml")} | (options or {})
    return load_gateway(given, environ, "my-robot.local").settings


def test_it_runs_beside_the_agent_of_the_same_file(tmp_path: Path) -> None:
    text = """
        name = "base"
        domain = 3
        [core]
        mode = "external"
        master = "http://localhost:11311/"
        port = 11399
        [mesh]
        port = 40001
        [web]
        enabled = true
        [[contract]]
        topics = ["/a"]
        depth = 1
    """
    found = load(tmp_path, text, ROS_MASTER_URI="http://localhost:11311", RMPA_PORT="40001")
    assert (found.name, found.core_mode, found.core_port, found.port) == ("base_gateway", "embedded", 0, 0)
    assert not found.web.enabled
    assert found.relay
    assert found.domain == 3  # it is in the same mesh, by the same rules
    assert len(found.contracts) == 1


def test_its_own_options_say_name_and_ports(tmp_path: Path) -> None:
    options: dict[str, object] = {"name": "gate", "core_port": "11400", "port": "40002", "core_host": "0.0.0.0"}
    found = load(tmp_path, '[core]\nport = 1\n[gateway]\nsite = "a"\n', options, RMPA_NAME="base")
    assert (found.name, found.core_port, found.port, found.core_host) == ("gate", 11400, 40002, "0.0.0.0")
    assert found.gateway.site == "a"


def test_without_a_name_it_is_the_hosts(tmp_path: Path) -> None:
    assert load(tmp_path).name == "my_robot_gateway"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "there is nothing to join; say --site NAME"),
        (("--site", "a"), "there is no connection to other sites; add --connect, such as tls/fleet.example:7447"),
        (("--ros2", "--ros2-via", "zenoh"), "add --connect, such as tcp/localhost:7447 for rmw_zenohd here"),
        (("--router",), "a router that listens nowhere; add --listen"),
        (("--site", "ros2", "--connect", "tcp/a:1"), "--site: ros2 is reserved"),
        (("--site", "a", "zenoh-config"), "--site: must come after zenoh-config"),
        (("zenoh-conf",), "Did you mean `rmpa gateway zenoh-config`?"),
        (("--site", "a", "--connect", "fleet:7447"), "did you mean --connect tls/fleet:7447?"),
    ],
)
def test_a_wrong_command_line_ends_with_code_2_and_what_to_write(
    place: Place, arguments: tuple[str, ...], words: str
) -> None:
    pytest.importorskip("zenoh", reason="the libraries of rmpa[zenoh] are not installed")
    code, _, err = place.run("gateway", *arguments)
    assert code == 2, err
    assert words in err


@pytest.mark.parametrize("missing", ["zenoh", "xxhash"])
def test_without_the_extra_the_error_says_how_to_install_it(
    place: Place, monkeypatch: pytest.MonkeyPatch, missing: str
) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    code, _, err = place.run(*SITE, "--connect", "tcp/localhost:1", "--insecure")
    assert (code, "-m pip install 'rmpa[zenoh]'" in err) == (2, True)


def test_help_shows_all_options_and_needs_no_library(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "zenoh", None)
    code, out, err = place.run("gateway", "--help")
    assert code == 0, err
    for option in ("--site", "--connect", "--listen", "--router", "--rank", "--insecure", "--ros2-domain", "--seed"):
        assert option in out
    assert "zenoh-config" in out


def test_a_configuration_for_zenohd_is_printed(place: Place) -> None:
    zenoh = pytest.importorskip("zenoh", reason="the libraries of rmpa[zenoh] are not installed")
    code, _, err = place.run("gateway", "zenoh-config", "--name", "fleet")
    assert code == 1
    assert "rmpa trust" in err
    assert "--insecure" in err
    code, out, err = place.run("gateway", "zenoh-config", "--listen", "tcp/0.0.0.0:7448", "--insecure")
    assert code == 0, err
    config = zenoh.Config.from_json5(out)
    assert json.loads(config.get_json("listen/endpoints")) == ["tcp/0.0.0.0:7448"]
    assert json.loads(config.get_json("mode")) == "router"
