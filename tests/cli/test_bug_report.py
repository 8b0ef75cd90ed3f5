"""``rmpa bug-report``: complete, whatever runs, and without what no other person is to see."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tarfile
from typing import TYPE_CHECKING

import msgspec
import pytest

from rmpa.cli import bug_report
from rmpa.cli.main import main
from rmpa.cli.redact import Redactor, is_secret, without_passwords
from tests.cli.conftest import end, free_port, until
from tests.observe.samples import SNAPSHOT

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tests.cli.conftest import Place

JOIN = "rmpa1-" + "abcdefghijklmnop234567" * 4
PEM = "-----BEGIN PRIVATE KEY-----\nMIIEvQIBADANBgkq\nhkiG9w0BAQEFAASC\n-----END PRIVATE KEY-----"
RANDOM = "Zm9vYmFyMTIzNDU2Nzg5MGFiY2RlZkdISUpLTE1OT1A"
EACH = {"README.txt", "doctor.json", "log.txt", "service.txt", "settings.json", "state.txt", "system.json"}
EACH |= {"trust.json", "version.json"}
OF_AGENT = {"peers.txt", "topics.txt", "services.txt", "nodes.txt", "sites.txt", "snapshot.json"}


def files_of(archive: Path) -> dict[str, str]:
    with tarfile.open(archive) as tar:
        assert {(each.uid, each.uname, each.gname) for each in tar} == {(0, "", "")}
        read = {each.name.partition("/")[2]: tar.extractfile(each) for each in tar}
        return {name: file.read().decode() for name, file in read.items() if file is not None}


def report(place: Place, *words: str) -> dict[str, str]:
    code, out, err = place.run("bug-report", "-o", "report.tar.gz", *words)
    assert (code, err) == (0, "")
    assert "report.tar.gz is written" in out
    assert (place.path / "report.tar.gz").stat().st_mode & 0o777 == 0o600
    return files_of(place.path / "report.tar.gz")


def test_without_an_agent_everything_else_is_told(place: Place) -> None:
    files = report(place)
    assert set(files) == EACH
    assert json.loads(files["version.json"])["protocols"]
    assert {each["check"] for each in json.loads(files["doctor.json"])} > {"settings", "interface", "clock"}
    assert json.loads(files["system.json"])["kernel"].startswith("Linux ")
    assert len(json.loads(files["settings.json"])["settings"]) > 50
    assert place.run("bug-report", "-o", "report.tar.gz")[0] == 2, "it is there already"


def test_of_each_agent_the_lists_and_the_snapshot(place: Place, agent: Callable[..., None]) -> None:
    agent("base")
    agent("arm", msgspec.structs.replace(SNAPSHOT, agent=msgspec.structs.replace(SNAPSHOT.agent, name="arm")))
    place.environ["ROS_MASTER_URI"] = "http://127.0.0.1:9/"
    files = report(place)
    assert set(files) == EACH | {f"{name}/{file}" for name in ("base", "arm") for file in OF_AGENT}
    assert json.loads(files["base/snapshot.json"])["agent"]["guid"] == SNAPSHOT.agent.guid
    assert "joystick" in files["base/peers.txt"]


def test_secrets_of_every_place_are_taken_out(place: Place, agent: Callable[..., None]) -> None:
    """Planted in settings, variables, state directory, addresses, log lines and what an agent says."""
    state = place.path / ".local/state/rmpa"
    (state / "base" / "trust").mkdir(parents=True)
    (state / "base" / "trust" / "module.key").write_text(PEM)
    (state / "base" / "web-token").write_text("plain-web-token\n")
    (place.path / "kept-token").write_text("kept-elsewhere\n")
    (place.path / "rmpa.toml").write_text(
        f'[web]\norigins = ["https://me:origin-pass@example.org"]\ntoken_file = "{place.path}/kept-token"\n'
        '[gateway]\nsite = "hall"\n'
    )
    place.environ |= {
        "RMPA_WEB_PASSWORD": "env-secret",
        "ROS_MASTER_URI": "http://me:uri-pass@10.0.0.9:11311",
        "ROS_TOKEN": "env-token-value",
        "USER": "susanne",
    }
    lines = [
        f"12:00 I joined with {JOIN}",
        "12:01 W http://host:8480/?token=query-token-1 was opened by susanne",
        "12:02 D Authorization: Bearer bearer.value-77",
        'password = "two words here"; {"api_key": "json-key-value"}',
        f"{PEM} in the middle",
        f"a random text {RANDOM} of unknown use",
        "rmpa web --token option-token --token-file /home/susanne/t",
        "the web server has plain-web-token and kept-elsewhere, and said env-token-value",
        "joystick is at 10.0.0.2",
        "/home/susanne/catkin_ws/src and /root/x and /home/other/y",
    ]
    (place.path / "up.log").write_text("\n".join(lines))
    agent("base", msgspec.structs.replace(SNAPSHOT, notes=("cannot reach ftp://bob:note-pass@10.0.0.3/", JOIN)))
    files = report(place, "--log", "up.log")
    every = "\n".join([*files, *files.values()])
    secrets = (JOIN, "MIIEvQIBADANBgkq", "hkiG9w0BAQEFAASC", RANDOM, "origin-pass", "env-secret", "uri-pass")
    more = ("env-token-value", "query-token-1", "bearer.value-77", "two words", "json-key-value", "option-token")
    for planted in (
        *secrets,
        *more,
        "plain-web-token",
        "kept-elsewhere",
        "note-pass",
        "susanne",
        "/home/",
        "/root/x",
    ):
        assert planted not in every, planted
    assert str(place.path) not in every, "it is the home here"
    assert "rmpa web --token [redacted] --token-file ~/t" in files["up.log"]
    assert "joystick is at 10.0.0.2" in files["up.log"], "names and addresses stay"
    assert "~/catkin_ws/src and ~/x and ~/y" in files["up.log"]
    assert "http://[redacted]@10.0.0.9:11311" in files["system.json"]
    assert "module.key" in files["state.txt"], "names and sizes alone"


def test_anonymous_replaces_each_name_by_one_word(place: Place, agent: Callable[..., None]) -> None:
    agent("base")
    place.environ |= {"ROS_MASTER_URI": "http://robot-7.example.org:11311", "ROS_STATIC_PEERS": "depot.example.org"}
    (place.path / "up.log").write_text(
        "joystick is at 10.0.0.2 and fe80::1:2%eth0, mac 02:42:ac:11:00:02, 127.0.0.1\n"
    )
    files = report(place, "--log", "up.log", "--anonymous")
    every = "\n".join([*files, *files.values()])
    names = (
        os.uname().nodename,
        "joystick",
        "robot-7.example.org",
        "depot.example.org",
        "10.0.0.2",
        "fe80::1:2",
        "02:42:ac",
    )
    for name in names:
        assert name not in every, name
    peer, address = files["up.log"].split(" is at ")[0], files["up.log"].split()[3]
    (snapshot,) = (json.loads(text) for name, text in files.items() if name.endswith("snapshot.json"))
    assert peer in [one["name"] for one in snapshot["peers"]]
    assert any(each.startswith(address) for one in snapshot["peers"] for each in one["addresses"])
    assert "127.0.0.1" in files["up.log"]


@pytest.mark.parametrize(
    ("said", "kept"),
    [
        ("peer joystick: a wrong token was refused", "peer joystick: a wrong token was refused"),
        ("/robot/camera/image_raw/compressed of 0123456789abcdef0123456789abcdef", None),
        ("sensor_msgs/PointCloud2 10.0.0.1:40001#7 keys: group key 3", None),
        ("token_file = /etc/rmpa/web-token", None),
        ("http://10.0.0.2:8480/", None),
        ("tokens: 2", "tokens: [redacted]"),
    ],
)
def test_what_a_maintainer_reads_stays(said: str, kept: str | None) -> None:
    assert Redactor().text(said) == (said if kept is None else kept)


def test_what_was_taken_out_is_counted() -> None:
    redactor = Redactor(["the-secret"], ["/home/a"], ["susanne", "robot"])
    told = redactor.value(
        {"password": "x", "say": "the-secret of susanne's robot", "n": 3, "none": None, "tokens": []}
    )
    assert told == {
        "password": "[redacted]",
        "say": "[redacted] of [user]'s robot",
        "n": 3,
        "none": None,
        "tokens": [],
    }
    counts = {what: count for what, count in redactor.counts.items() if count}
    assert counts == {"values of secret names": 1, "secrets of this machine": 1, "user names": 1}
    assert is_secret("RMPA_TOKEN")
    assert not is_secret("web.token_file")
    assert without_passwords("ws://a:b@c:1/") == "ws://[redacted]@c:1/"


def test_an_agent_that_does_not_answer_holds_nothing_up(
    place: Place, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    port = f"239.255.82.77:{20000 + os.getpid() % 20000}"
    words = ["--name", "base", "--interface", "lo", "--multicast", port, "--core-port", str(free_port())]
    process = subprocess.Popen(
        [sys.executable, "-m", "rmpa", "up", *words], env=place.environ, cwd=place.path, text=True
    )
    try:
        until((place.path / "base.sock").exists)
        process.send_signal(signal.SIGSTOP)
        for name in [name for name in os.environ if name.startswith(("ROS_", "RMPA_", "XDG_"))]:
            monkeypatch.delenv(name)
        for name in ("RMPA_RUNTIME_DIR", "HOME"):
            monkeypatch.setenv(name, str(place.path))
        monkeypatch.chdir(place.path)
        monkeypatch.setattr(bug_report, "_SNAPSHOT", 0.5)
        monkeypatch.setattr(bug_report, "DEADLINE", 6.0)
        assert main(["bug-report", "-o", "folder", "--json"]) == 0
    finally:
        process.send_signal(signal.SIGCONT)
        end(process)
    told = json.loads(capsys.readouterr().out)
    assert set(told["files"]) == EACH | {f"base/{file}" for file in OF_AGENT}
    folder = place.path / "folder"
    assert folder.stat().st_mode & 0o777 == 0o700
    assert "in time" in (folder / "base/snapshot.json").read_text()
    assert "it was ended after 6 s" in (folder / "base/peers.txt").read_text(), "a command would wait for 10 s"


def test_a_program_that_hangs_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bug_report, "DEADLINE", 0.2)
    hangs = [sys.executable, "-c", "import time; print('begun', flush=True); time.sleep(600)"]
    files = bug_report.run_programs(
        {"a.txt": hangs, "b.txt": ["/nowhere/rmpa"], "c.txt": ["sh", "-c", "echo no >&2; exit 3"]}, {}
    )
    assert files["a.txt"].endswith("it was ended after 0.2 s\n")
    assert files["b.txt"] == "/nowhere/rmpa: No such file or directory\n"
    assert "no\n" in files["c.txt"]
