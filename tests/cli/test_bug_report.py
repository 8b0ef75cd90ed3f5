"""``rmpa bug-report``: complete, whatever runs, and without what no other person is to see."""

from __future__ import annotations

import json
import os
import resource
import socket
import sys
import tarfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import msgspec
import pytest

from rmpa.cli import bug_report
from rmpa.cli.bug_report import Redactor, is_secret
from rmpa.cli.main import main
from rmpa.cli.output import without_passwords
from rmpa.runtime.interpreter import own_command
from tests.cli.conftest import Place
from tests.observe.samples import SNAPSHOT

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
    assert (code, err, "report.tar.gz is written" in out) == (0, "", True)
    assert (place.path / "report.tar.gz").stat().st_mode & 0o777 == 0o600
    return files_of(place.path / "report.tar.gz")


@pytest.fixture
def here(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs the commands of a report within this process."""
    run, own = bug_report.run_programs, own_command()

    def run_here(
        programs: Mapping[str, list[str]], environ: Mapping[str, str]
    ) -> tuple[dict[str, str], dict[str, str]]:
        found, missing = run({file: words for file, words in programs.items() if words[: len(own)] != own}, environ)
        for file in programs.keys() - found.keys():
            code, out, err = place.run(*programs[file][len(own) :])
            found[file] = out if out and file.endswith(".json") else f"{out}exit code {code}\n{err}"
        return found, missing

    monkeypatch.setattr(bug_report, "run_programs", run_here)


def test_without_an_agent_everything_else_is_told(place: Place) -> None:
    files = report(place)
    assert set(files) == EACH
    assert json.loads(files["version.json"])["protocols"]
    assert {each["check"] for each in json.loads(files["doctor.json"])} > {"settings", "interface", "clock"}
    assert json.loads(files["system.json"])["kernel"].startswith("Linux ")
    assert len(json.loads(files["settings.json"])["settings"]) > 50
    assert place.run("bug-report", "-o", "report.tar.gz")[0] == 2, "it is there already"


@pytest.mark.usefixtures("here")
def test_of_each_agent_the_lists_and_the_snapshot(place: Place, agent: Callable[..., None]) -> None:
    agent("base")
    agent("arm", msgspec.structs.replace(SNAPSHOT, agent=msgspec.structs.replace(SNAPSHOT.agent, name="arm")))
    place.environ["ROS_MASTER_URI"] = "http://127.0.0.1:9/"
    files = report(place)
    assert set(files) == EACH | {f"{name}/{file}" for name in ("base", "arm") for file in OF_AGENT}
    assert json.loads(files["base/snapshot.json"])["agent"]["guid"] == SNAPSHOT.agent.guid
    assert "joystick" in files["base/peers.txt"]


@pytest.mark.usefixtures("here")
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
        "ROS_MASTER_URI": "http://me:uri-pa/s@s@10.0.0.9:11311",
        "ROS_PWD": "hunter2a",
        "ROS_OTHER": "hunter2b",
        "RMPA_GATEWAY_X": "hunter3",
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
        "/home/susanne/catkin_ws/src and /root/x and /home/other/y, of other",
        "tcp/u:hunter4@host:7447 u:hunter5@host http://a:p@hunter6@h rmpa@base.service",
        "the password hunter7 is wrong; pw=hunter9 auth=hunter10 ",
        "pwd: hunter11",
        'seeds = ["carol:hunter8@5.6.7.8:1"]',
        "PGPASS=hunter12 api-key: hunter13 private-key=hunter14 x_token=ab;hunter18&hunter19",
        "wifi_psk_value=hunter15",
        f"keys {'0123abcd' * 5}01234567 {'0123abcd' * 4}0 of /Users/hunter16/x",
        "passphrase: my hunter17 words",
        "password=ab&hunter20;hunter21",
        f"{'many words ' * 1000}the end",
    ]
    (place.path / "up.log").write_text("\n".join(lines))
    agent("base", msgspec.structs.replace(SNAPSHOT, notes=("cannot reach ftp://bob:note-pass@10.0.0.3/", JOIN)))
    files = report(place, "--log", "up.log")
    every = "\n".join([*files, *files.values()])
    for planted in (
        *(JOIN, "MIIEvQIBADANBgkq", "hkiG9w0BAQEFAASC", RANDOM, "origin-pass", "env-secret", "uri-pa", "s@s"),
        *("env-token-value", "query-token-1", "bearer.value-77", "two words", "json-key-value", "option-token"),
        *("hunter", "carol", "0123abcd", "of other", "plain-web-token", "kept-elsewhere", "note-pass", "susanne"),
        *("/home/", "/root/x"),
    ):
        assert planted not in every, planted
    assert str(place.path) not in every, "it is the home here"
    assert "rmpa web --token [redacted] --token-file ~/t" in files["up.log"]
    assert "joystick is at 10.0.0.2" in files["up.log"], "names and addresses stay"
    assert "~/catkin_ws/src and ~/x and ~/y, of [user]" in files["up.log"]
    assert "http://[redacted]@10.0.0.9:11311" in files["system.json"]
    assert {"ROS_PWD", "ROS_OTHER", "RMPA_GATEWAY_X"} < set(json.loads(files["system.json"])["variables"])
    assert 'seeds = ["[redacted]@5.6.7.8:1"]' in files["up.log"]
    assert "rmpa@base.service" in files["up.log"], "a unit's name is no address"
    assert "many words [6915 characters cut]" in files["up.log"]
    assert "module.key" in files["state.txt"], "names and sizes alone"


@pytest.mark.usefixtures("here")
def test_names_that_are_not_utf8_are_written(place: Place) -> None:
    (place.path / ".local/state/rmpa").mkdir(parents=True)
    (place.path / ".local/state/rmpa" / os.fsdecode(b"caf\xe9")).touch()
    place.environ["ROS_PACKAGE_PATH"] = os.fsdecode(b"/caf\xe9")
    files = report(place)
    assert "caf\\udce9" in files["state.txt"]
    assert json.loads(files["system.json"])["variables"]["ROS_PACKAGE_PATH"] == "/caf\udce9"
    name = os.fsdecode(b"\xe9")
    assert place.json("bug-report", "-o", name, "--json")[0]["file"] == "\\udce9"
    assert "caf\\udce9" in (place.path / name / "state.txt").read_text()


@pytest.mark.parametrize("name", ["report.tar.gz", "report"])
def test_a_full_disk_leaves_nothing(tmp_path: Path, name: str) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        with pytest.raises(OSError, match="too large"):
            bug_report._write(tmp_path / name, {"a/b.txt": os.urandom(90_000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(tmp_path.iterdir()) == []


def test_a_log_that_only_root_may_read_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bug_report, "run_programs", lambda programs, _: (dict.fromkeys(programs, ""), {}))
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert main(["bug-report", "-o", str(tmp_path / "folder")]) == 0
    assert "only root may read its log: sudo rmpa bug-report" in capsys.readouterr().out


@pytest.mark.parametrize("part", ["a-", "http://a:", "password ", 'token=\\" ', "_key", "aA1+", "a@", ":"])
@pytest.mark.parametrize("end", ["", "\n"])
def test_the_time_is_linear_in_the_text(part: str, end: str) -> None:
    lines = 33 if end else 1
    text = (part * (128 * 1024 // lines // len(part)) + end) * lines
    begun, redactor = time.monotonic(), Redactor(["the-secret"], ["/home/a"], ["susanne"])
    redactor.anonymise([text], ["depot"], ["joystick"])
    redactor.text(text)
    assert time.monotonic() - begun < 10


@pytest.mark.usefixtures("here")
def test_anonymous_replaces_each_name_by_one_word(place: Place, agent: Callable[..., None]) -> None:
    agent("base")
    place.environ |= {"ROS_MASTER_URI": "http://robot-7.example.org:11311", "ROS_STATIC_PEERS": "depot.example.org"}
    (place.path / "up.log").write_text(
        "joystick is at 10.0.0.2 and fe80::1:2%eth0, mac 02:42:ac:11:00:02, 127.0.0.1\n"
        "peer wagon-3: no answer\nrmpa up --name wagon-4\nwagon-3, wagon-4 and wagon-5\n"
    )
    (place.path / "rmpa.toml").write_text('name = "wagon-5"\nit cannot be read')
    files = report(place, "--log", "up.log", "--anonymous")
    every = "\n".join([*files, *files.values()])
    telling = ("joystick", "wagon", "robot-7.example.org", "depot.example.org", "10.0.0.2", "fe80::1:2", "02:42:ac")
    for name in (os.uname().nodename, *telling):
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


def test_an_agent_that_does_not_answer_holds_nothing_up(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bug_report, "_SNAPSHOT", 0.5)
    monkeypatch.setattr(bug_report, "run_programs", lambda programs, _: (dict.fromkeys(programs, ""), {}))
    with socket.socket(socket.AF_UNIX) as mute:
        mute.bind(str(place.path / "base.sock"))
        mute.listen(100)
        code, out, err = place.run("bug-report", "-o", "folder")
        told = json.loads(place.run("bug-report", "-o", "other", "--json")[1])["missing"]
    assert (code, err) == (1, "")
    missing = [line for line in out.splitlines() if line.startswith("missing: ")]
    assert len(missing) == 1, missing
    assert missing[0].startswith("missing: base/snapshot.json: no agent answers at ")
    assert missing == [f"missing: {file}: {why}" for file, why in told.items()]
    folder = place.path / "folder"
    assert folder.stat().st_mode & 0o777 == 0o700
    assert {each.name for each in (folder / "base").iterdir()} == {"snapshot.json"}
    assert "in time" in (folder / "base/snapshot.json").read_text()


def test_a_program_that_hangs_is_ended_and_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bug_report, "DEADLINE", 0.2)
    hangs = [sys.executable, "-c", "import time; print('begun', flush=True); time.sleep(600)"]
    files, missing = bug_report.run_programs({"a.txt": hangs, "b.txt": ["/nowhere/rmpa"]}, {})
    assert files["a.txt"].endswith("it was ended after 0.2 s\n")
    assert files["b.txt"] == "/nowhere/rmpa: No such file or directory\n"
    assert missing == {"a.txt": "it was ended after 0.2 s"}


def test_each_program_has_its_own_time_and_few_run_at_once(tmp_path: Path) -> None:
    """Each notes that it runs, and counts those that do: on a busy machine all at once would leave time for none."""
    count = f"mkdir {tmp_path}/$$; ls {tmp_path} | wc -l; sleep 0.05; rmdir {tmp_path}/$$"
    programs = {f"{number}.txt": ["sh", "-c", count] for number in range(12)}
    files, missing = bug_report.run_programs({**programs, "c.txt": ["sh", "-c", "echo no >&2; exit 3"]}, {})
    assert not missing
    assert files.pop("c.txt") == "exit code 3\nno\n"
    assert {int(text) for text in files.values()} <= {1, 2, 3, 4}
