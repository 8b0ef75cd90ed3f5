"""``rmpa init``: what is found on a machine, and a file that ``rmpa up`` takes as it is."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Callable
from ipaddress import IPv4Interface
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from rmpa.cli.init import Finding, file_text
from rmpa.cli.init import _interfaces as of_interfaces
from rmpa.cli.units import config_text
from rmpa.config.read import load_settings
from rmpa.config.settings import Settings
from rmpa.core.identity import peer_name_from
from rmpa.discovery.network import Interface
from rmpa.observe import limits
from rmpa.ros.core.embedded import RosCore
from tests.cli.conftest import Place, free_port, with_core

LO = Interface("lo", (IPv4Interface("127.0.0.1/8"),), loopback=True)
WLAN = Interface("wlan0", (IPv4Interface("192.168.1.5/24"),))
ETH = Interface("eth0", (IPv4Interface("10.0.0.5/24"),))
CABLE = Interface("eth1", up=False, used=False)
DOCKER = Interface("docker0", (IPv4Interface("172.17.0.1/16"),))


def settings_of(path: Path) -> Settings:
    """What the file alone says; nothing of it is doubtful."""
    loaded = load_settings({"config": str(path)}, {}, host_name="other")
    assert loaded.notes == ()
    return loaded.settings


def found(place: Place, **environ: str) -> dict[str, dict[str, Any]]:
    place.environ |= environ
    (told,) = place.json("init", "--json", "--force")
    return {each["setting"]: each for each in told["found"]}


def test_what_is_written_is_what_was_found_and_all_else_is_a_default(place: Place) -> None:
    code, out, err = place.run("init")
    assert (code, err) == (0, "")
    assert out.splitlines()[-1] == "rmpa.toml is written. Next: rmpa up"
    text = (place.path / "rmpa.toml").read_text()
    added = [line for line in text.splitlines() if line not in config_text().splitlines()]
    assert all(line.startswith(("# ", "name = ", "interfaces = ")) for line in added)
    settings = settings_of(place.path / "rmpa.toml")
    assert settings.name == peer_name_from(socket.gethostname())
    assert (settings.domain, settings.core_mode, settings.relay) == (0, "embedded", False)


def test_the_variables_of_ros_stand_in_the_file(place: Place) -> None:
    port = free_port()
    given = found(
        place,
        ROS_MASTER_URI=f"http://localhost:{port}",
        ROS_DOMAIN_ID="7",
        ROS_STATIC_PEERS="10.0.0.2;arm:40001",
        ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST",
        ROS_PACKAGE_PATH="/opt/ros/noetic/share:/home/arm/catkin_ws/src",
    )
    assert given["domain"] == {"setting": "domain", "value": 7, "found": "ROS_DOMAIN_ID is set"}
    assert "/home/arm/catkin_ws/src" in str(given["web.enabled"]["found"])
    assert "/opt/ros" not in str(given["web.enabled"]["found"])
    settings = settings_of(place.path / "rmpa.toml")
    assert (settings.domain, settings.core_port, settings.interfaces) == (7, port, ("lo",))
    assert [str(seed) for seed in settings.seeds] == ["10.0.0.2", "arm:40001"]
    for name in [name for name in place.environ if name.startswith("ROS_")]:
        del place.environ[name]
    (shown,) = place.json("config", "show", "--json")
    origins = {each["name"]: each["from"] for each in shown["settings"]}
    assert all(str(origins[key]).startswith("rmpa.toml:") for key in ("domain", "core.port", "discovery.seeds"))


def test_a_roscore_that_runs_is_joined(place: Place, core: RosCore) -> None:
    given = found(place, ROS_MASTER_URI=core.uri.replace("127.0.0.1", "localhost"))
    port = urlsplit(core.uri).port
    assert given["core.mode"]["value"] == "external"
    assert "core.port" not in given, "it is of no use with an external core"
    assert f"is the ROS master at port {port}" in str(given["core.mode"]["found"])
    settings = settings_of(place.path / "rmpa.toml")
    assert (settings.core_mode, settings.core_master) == ("external", f"http://localhost:{port}/")


def test_beside_another_agent_the_core_gets_another_port(
    place: Place, core: RosCore, agent: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    agent(snapshot=with_core(core.uri))
    port = urlsplit(core.uri).port or 0
    given = found(place, ROS_MASTER_URI=f"http://localhost:{port}")
    assert "core.mode" not in given
    assert given["core.port"]["value"] == port + 1
    assert "the agent base has port" in str(given["core.port"]["found"])
    monkeypatch.setattr(socket, "gethostname", lambda: "base")
    assert "the agent base runs here" in str(found(place)["name"]["found"])


@pytest.mark.parametrize(
    ("there", "value", "words"),
    [
        ((LO, WLAN), None, "wlan0 (192.168.1.5/24) can be used"),
        ((LO, WLAN, CABLE, DOCKER), ("lo", "wlan0", "eth1"), "left out: docker0 (containers"),
        ((LO,), None, "no network but loopback"),
        ((LO, DOCKER), None, "left out: docker0 (containers"),
    ],
)
def test_interfaces(there: tuple[Interface, ...], value: object, words: str) -> None:
    (one,) = of_interfaces(there)
    assert one.value == value
    assert words in one.text


def test_a_machine_in_two_networks_is_told_of_relay() -> None:
    _, relay = of_interfaces((LO, ETH, WLAN, DOCKER))
    assert relay.key == ("relay", "enabled")
    assert relay.value is None, "whether networks are to be joined is for the user to say"
    assert "10.0.0.0/24 and 192.168.1.0/24" in relay.text


def test_each_comment_stands_above_its_line_and_ends_no_line() -> None:
    text = file_text([Finding(("core", "port"), "a\nb " + "x " * 100, 7), Finding(("relay", "enabled"), "two")])
    lines = text.splitlines()
    at = lines.index("port = 7")
    assert lines[at - 2].startswith("# Found: a\\nb x x")
    assert lines[lines.index("# Found: two") + 1] == "# enabled = false"
    assert max(len(line) for line in lines[at - 2 : at]) <= 118
    assert text.startswith("# Written by `rmpa init`")


def test_what_is_there_is_not_replaced_and_a_print_writes_nothing(place: Place) -> None:
    code, out, _ = place.run("init", "-")
    assert code == 0
    assert "\n[core]\n" in out
    assert not (place.path / "rmpa.toml").exists()
    assert place.run("init", "--dry-run")[1] == out
    (place.path / "rmpa.toml").write_text("domain = 3\n")
    code, _, err = place.run("init")
    assert (code, err.startswith("rmpa: rmpa.toml: is there already; --force")) == (1, True)
    assert place.run("init", "--force")[0] == 0
    assert settings_of(place.path / "rmpa.toml").domain == 0


def test_on_a_full_disk_what_was_there_stays(place: Place) -> None:
    path = place.path / "rmpa.toml"
    path.write_text("domain = 3\n")
    path.chmod(0o640)
    command = ["sh", "-c", 'ulimit -f 1; exec "$@"', "-", sys.executable, "-m", "rmpa.cli.main", "init", "--force"]
    environ = {**place.environ, "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(command, env=environ, cwd=place.path, capture_output=True, text=True, check=False)
    assert (done.returncode, "rmpa.toml: cannot be written: " in done.stderr) == (1, True)
    assert [each.read_text() for each in place.path.iterdir()] == ["domain = 3\n"]
    assert place.run("init", "--force")[0] == 0
    assert [each.name for each in place.path.iterdir()] == ["rmpa.toml"]
    assert path.stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize("words", [(), ("--force",)])
def test_a_link_is_not_replaced(place: Place, words: tuple[str, ...]) -> None:
    (place.path / "rmpa.toml").symlink_to("other.toml")
    code, _, err = place.run("init", *words)
    assert (code, err.startswith("rmpa: rmpa.toml: is ")) == (1, True)
    assert (place.path / "rmpa.toml").is_symlink()
    assert not (place.path / "other.toml").exists()


def test_an_agent_that_does_not_answer_is_told_of_in_time(place: Place) -> None:
    start = time.monotonic()
    with socket.socket(socket.AF_UNIX) as stopped:
        stopped.bind(str(place.path / "base.sock"))
        stopped.listen()
        code, out, err = place.run("init", "-")
    assert (code, "\n[core]\n" in out) == (0, True)
    assert "the port of the agent base is not known: " in err
    assert time.monotonic() - start < limits.CONTROL_CALL_TIMEOUT


def test_no_password_of_a_variable_is_told(place: Place) -> None:
    place.environ["ROS_MASTER_URI"] = "http://me:hunter2@10.1.1.1:11311"
    code, out, err = place.run("init")
    assert code == 0
    assert "hunter2" not in out + err + (place.path / "rmpa.toml").read_text()
    assert "names another machine and is ignored" in err


def test_the_file_of_the_system_is_roots(place: Place) -> None:
    code, _, err = place.run("init", "--system", "file.toml")
    assert (code, "leave out FILE or --system" in err) == (2, True)
