"""``rmpa service install``, ``status``, ``uninstall``: a machine below a folder, a systemd of the test."""

from __future__ import annotations

import json
import os
import pwd
import shlex
import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from rmpa.cli import boot, units
from rmpa.cli.boot import Former
from rmpa.cli.main import main
from rmpa.cli.units import Machine
from rmpa.config import module_name
from rmpa.config.settings import Settings, TrustSettings
from rmpa.core.errors import RmpaError, StartError
from rmpa.observe import control_client
from tests.cli.conftest import compare

_PROGRAMS = {
    "systemctl": """
echo "systemctl $*" >> {place}/calls
case $1 in
    show) cat {place}/$2.show 2>/dev/null || echo LoadState=not-found ;;
    enable) for unit; do [ ! -e {place}/$unit.fails ] || {{ echo "Job for $unit failed." >&2; exit 1; }}; done ;;
esac
""",
    "journalctl": "echo 'info    agent     = base, domain 0: peers can find it'",
    "groupadd": 'echo "$4:x:4243:" >> "$2/etc/group"',
    "useradd": 'for name; do :; done; echo "$name:x:4242:4243::/:/bin/false" >> "$2/etc/passwd"',
    "userdel": 'sed -i "/^$3:/d" "$2/etc/passwd"',
    "groupdel": 'sed -i "/^$3:/d" "$2/etc/group"',
}
_RUNS = (
    "LoadState=loaded\nActiveState=active\nSubState=running\nUnitFileState=enabled\nResult=success\nMainPID=4711\n"
)


class Systemd:
    """The programs of systemd and of the user database, which write down how they are called."""

    def __init__(self, place: Path) -> None:
        self.place = place
        for name, text in _PROGRAMS.items():
            program = place / name
            program.write_text(f"#!/bin/sh\n{text.format(place=place) if name == 'systemctl' else text}\n")
            program.chmod(0o755)

    def calls(self) -> list[str]:
        """The calls that change something, since the last time."""
        file = self.place / "calls"
        lines = file.read_text().splitlines() if file.exists() else []
        file.unlink(missing_ok=True)
        return [line for line in lines if not line.startswith("systemctl show")]

    def show(self, unit: str, text: str) -> None:
        since = f"{time.clock_gettime(time.CLOCK_MONOTONIC) - 7530:.0f}000000"
        (self.place / f"{unit}.show").write_text(f"{text}StateChangeTimestampMonotonic={since}\n")


@pytest.fixture
def systemd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Systemd:
    place = tmp_path / "programs"
    place.mkdir()
    monkeypatch.setenv("PATH", f"{place}:{os.environ['PATH']}")
    monkeypatch.setattr(units, "_BOOTED", tmp_path)
    for module in (boot, units):
        monkeypatch.setattr(module, "own_program", lambda: "/opt/rmpa/bin/rmpa")
    return Systemd(place)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Another system."""
    etc = tmp_path / "root" / "etc"
    etc.mkdir(parents=True)
    (etc / "passwd").touch()
    (etc / "group").touch()
    return etc.parent


def _files(root: Path) -> dict[str, str]:
    return {str(path.relative_to(root)): path.read_text() for path in root.rglob("*") if path.is_file()}


@pytest.fixture
def service(systemd: Systemd, root: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs lines of ``rmpa service`` for the other system: what each says and calls."""

    def run(*lines: str) -> str:
        said = ""
        for line in lines:
            code = main(["service", *shlex.split(line), "--root", str(root)])
            out, err = capsys.readouterr()
            said += f"$ rmpa service {line}\n{out}{err}exit code {code}\n"
            said += "".join(f"called {call}\n" for call in systemd.calls()) + "\n"
        return said.replace(str(root), "ROOT")

    return run


Service = Callable[..., str]


def test_a_machine_below_a_folder(service: Service, root: Path) -> None:
    before = _files(root)
    said = service("install --name base --web --realtime --dry-run")
    assert _files(root) == before
    said += service(
        "install --name base --web --realtime --resources", "install --web --realtime", "install --json",
        "install --name 1base",
        "uninstall --dry-run", "uninstall", "uninstall --purge --yes --json", "uninstall",
    )  # fmt: skip
    compare("boot", said)
    assert _files(root) == before


def test_the_package_has_units_of_its_own(service: Service, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    service("install")  # by pip
    unit = root / "usr/lib/systemd/system/rmpa.service"
    unit.parent.mkdir(parents=True)
    unit.write_text("the package's")
    monkeypatch.setattr(boot, "own_program", lambda: "/usr/bin/rmpa")
    said = service("install")
    assert not list(root.glob("etc/systemd/system/*.service"))
    said += service("install --user pi", "uninstall --purge --yes", "uninstall")
    compare("boot_package", said)
    assert unit.read_text() == "the package's"


def test_a_unit_that_was_written_by_hand_is_kept(service: Service, root: Path) -> None:
    unit = root / "etc/systemd/system/rmpa.service"
    unit.parent.mkdir(parents=True)
    unit.write_text("mine")
    for _ in range(2):
        service("install")
        assert unit.with_name("rmpa.service.by-hand").read_text() == "mine"
    service("uninstall")
    assert {path.name: path.read_text() for path in unit.parent.iterdir()} == {"rmpa.service": "mine"}
    assert "called" not in service("uninstall")  # it is not ours to stop


def test_a_masked_unit_stays_masked(service: Service, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    unit, null = root / "etc/systemd/system/rmpa.service", root / "null"  # not this machine's, should the test fail
    null.touch()
    monkeypatch.setattr(os, "devnull", str(null))
    unit.parent.mkdir(parents=True)
    unit.symlink_to(null)
    problem = "/etc/systemd/system/rmpa.service: the unit is masked; systemctl --root ROOT unmask rmpa [service-unit]"
    assert service("install") == f"$ rmpa service install\nrmpa: {problem}\nexit code 1\n\n"


def test_what_a_link_leads_to_stays_as_it_is(root: Path) -> None:
    other, unit = root / "other", root / "etc/unit"
    other.write_text("other")
    other.chmod(0o600)
    unit.symlink_to(other)
    assert Machine(str(root), dry=False).write("/etc/unit", "text")
    assert (other.read_text(), other.stat().st_mode & 0o777) == ("other", 0o600)
    assert (unit.read_text(), unit.is_symlink(), unit.stat().st_mode & 0o777) == ("text", False, 0o644)


def test_a_name_that_the_settings_outweigh_is_refused(service: Service, root: Path) -> None:
    config = root / "etc/rmpa/rmpa.toml"
    config.parent.mkdir()
    config.write_text('domain = 7\nname = "base"\n')
    problem = "name: base outweighs --name arm; write it there, or remove the line [invalid-value]"
    said = f"$ rmpa service install --name arm\nrmpa: ROOT/etc/rmpa/rmpa.toml:2: {problem}\nexit code 2\n\n"
    assert service("install --name arm") == said
    assert "exit code 0" in service("install --name base")


def test_another_name_starts_the_units_again(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[object] = []
    monkeypatch.setattr(boot, "_start", lambda _, wanted, changed: started.append((wanted, changed)))
    service("install --name base", "install --name arm", "install --name arm")
    assert started[1:] == [(["rmpa.service"], ["rmpa.service"]), (["rmpa.service"], [])]


@pytest.mark.parametrize("sign", ["'", '"', "\\", "\t"])
def test_a_program_that_systemd_cannot_start_is_refused(
    service: Service, monkeypatch: pytest.MonkeyPatch, sign: str
) -> None:
    monkeypatch.setattr(boot, "own_program", lambda: f"/opt/a{sign}b/rmpa")
    said = service("install")
    assert "\nrmpa: rmpa service install: systemd cannot start " in said
    assert said.endswith("[service-unit]\nexit code 1\n\n")


def test_purge_removes_a_state_directory_elsewhere(tmp_path: Path) -> None:
    state, place, image = tmp_path / "data/rmpa", tmp_path / "rmpa", tmp_path / "image"
    (state / "base").mkdir(parents=True)
    for link in (image, place):
        link.symlink_to(state)
    Machine("/image", dry=False).remove_folder(image)  # there it leads to another folder
    assert (image.is_symlink(), state.is_dir()) == (False, True)
    Machine("", dry=False).remove_folder(place)
    assert (place.is_symlink(), state.exists()) == (False, False)


def _make_user(root: Path) -> None:
    (root / "etc/passwd").write_text("rmpa:x:4242:4243::/:/bin/false\n")
    (root / "etc/group").write_text("rmpa:x:4243:\n")


def _former(tmp_path: Path) -> Former:
    state = tmp_path / "home" / ".local" / "state" / "rmpa"
    (state / "base" / "trust").mkdir(parents=True, mode=0o700)
    (state / "base" / "trust" / "module.key").write_text("secret")
    (state / "base" / "trust" / "module.key").chmod(0o600)
    (state / "module-name").write_text("base\n")
    (state / "state-directories").write_text("/elsewhere\n")
    config = tmp_path / "home" / "rmpa.toml"
    config.write_text("domain = 7\n")
    return Former("pi", config, state, "base", Settings())


def test_what_a_user_s_agent_has_kept_is_taken_over_once(tmp_path: Path, root: Path) -> None:
    before, changed = _former(tmp_path), Machine(str(root), dry=False)
    _make_user(root)
    place = root / "var/lib/rmpa"
    boot._take_over(changed, before, "rmpa", None)
    assert changed.changes == [
        f"copy what pi's agent has kept in {before.state}: the name base, base/ with keys of a secured mesh"
    ]
    key = place / "base/trust/module.key"
    assert _files(place) == {"module-name": "base\n", "base/trust/module.key": "secret"}
    assert key.stat().st_mode & 0o777 == 0o600
    if os.geteuid() == 0:
        assert {(path.stat().st_uid, path.stat().st_gid) for path in (place, *place.rglob("*"))} == {(4242, 4243)}
    key.write_text("a newer one")
    boot._take_over(changed, before, "rmpa", None)
    assert len(changed.changes) == 1
    assert key.read_text() == "a newer one"
    boot._take_over(changed, before, "rmpa", "arm")
    assert changed.changes[1:] == ["keep the name arm"]
    assert (place / "module-name").read_text() == "arm\n"


def test_of_several_modules_only_the_one_that_is_installed_is_copied(tmp_path: Path, root: Path) -> None:
    before, said = _former(tmp_path), list[str]()
    assert before.state is not None
    for other in ("base_gateway", "arm"):
        (before.state / other).mkdir()
        (before.state / other / "file").write_text(other)
    boot._take_over(Machine(str(root), dry=False, tell=said.append), before, "rmpa", None)
    copied = {"module-name": "base\n", "base/trust/module.key": "secret", "base_gateway/file": "base_gateway"}
    assert _files(root / "var/lib/rmpa") == copied
    assert said[0] == f"what other modules have kept stays in {before.state}: arm"


def test_one_without_keys_is_not_installed_beside_one_that_has_some(tmp_path: Path, root: Path) -> None:
    before = _former(tmp_path)
    with pytest.raises(StartError, match="install that one, --name base"):
        boot._take_over(Machine(str(root), dry=False), before, "rmpa", "arm")
    open_one = replace(before, settings=replace(before.settings, trust=TrustSettings(insecure=True)))
    boot._take_over(Machine(str(root), dry=False), open_one, "rmpa", "arm")
    assert _files(root / "var/lib/rmpa") == {"module-name": "arm\n"}


def test_links_and_pipes_are_not_taken_over(tmp_path: Path, root: Path) -> None:
    before, secret = _former(tmp_path), tmp_path / "secret"
    assert before.state is not None
    secret.write_text("root's")
    (before.state / "file").symlink_to(secret)
    (before.state / "folder").symlink_to(tmp_path)
    os.mkfifo(before.state / "pipe")
    boot._take_over(Machine(str(root), dry=False), before, "rmpa", None)
    copied = {str(path.relative_to(root / "var/lib/rmpa")) for path in (root / "var/lib/rmpa").rglob("*")}
    assert copied == {"base", "base/trust", "base/trust/module.key", "module-name"}


def test_a_copy_that_stops_midway_leaves_nothing(tmp_path: Path, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    before = _former(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "copyfileobj", full)
        with pytest.raises(StartError, match=r"No space left on device; nothing was copied"):
            boot._take_over(Machine(str(root), dry=False), before, "rmpa", None)
    assert not list((root / "var/lib").iterdir())
    boot._take_over(Machine(str(root), dry=False), before, "rmpa", None)
    assert (root / "var/lib/rmpa/base/trust/module.key").exists()


@pytest.mark.skipif(os.geteuid() != 0, reason="root alone can give files away")
def test_what_the_state_directory_has_already_is_not_given_away(tmp_path: Path, root: Path) -> None:
    _make_user(root)
    place = root / "var/lib/rmpa"
    place.mkdir(parents=True)
    os.chown(place, 4242, 4243)
    (place / "base").mkdir()  # where a link of that user led a moment ago
    boot._take_over(Machine(str(root), dry=False), _former(tmp_path), "rmpa", "arm")
    assert (place / "base").stat().st_uid == 0
    assert ((place / "module-name").stat().st_uid, (place / "module-name").read_text()) == (4242, "arm\n")


def test_the_settings_of_a_user_are_taken_over_unless_there_are_some(tmp_path: Path, root: Path) -> None:
    before, changed = _former(tmp_path), Machine(str(root), dry=False)
    for _ in range(2):
        boot._make_config(changed, before)
        assert (root / "etc/rmpa/rmpa.toml").read_text() == "domain = 7\n"
        (tmp_path / "home/rmpa.toml").write_text("domain = 8\n")
    assert changed.changes == [f"write /etc/rmpa/rmpa.toml: as {before.config}"]


def test_the_user_is_the_one_who_called_sudo(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    _former(tmp_path)
    here = pwd.getpwuid(os.geteuid())
    caller = pwd.struct_passwd((*here[:5], str(tmp_path / "home"), here.pw_shell))
    monkeypatch.setattr(pwd, "getpwuid", {os.geteuid(): here, 12345: caller}.__getitem__)
    found = boot.former({"SUDO_UID": "12345", "HOME": "/root"})
    assert (found.name, found.state) == ("base", tmp_path / "home/.local/state/rmpa")
    assert boot.former({"SUDO_UID": "12345"}, root="/mnt").state is None  # an image is another machine


@pytest.mark.skipif(os.geteuid() != 0, reason="root alone can be another user")
def test_the_owner_runs_a_program_that_others_cannot_reach(tmp_path: Path) -> None:
    home = Path(tempfile.mkdtemp(dir="/tmp"))  # others can reach it, unlike tmp_path
    try:
        program = home / "rmpa"
        program.write_text("#!/bin/sh\n")
        program.chmod(0o755)
        home.chmod(0o755)
        assert boot.choose_user(str(program)) == "rmpa"
        home.chmod(0o700)
        with pytest.raises(StartError, match="install it elsewhere"):
            boot.choose_user(str(program))
        nobody = pwd.getpwnam("nobody")
        daemon = pwd.getpwnam("daemon")
        assert nobody.pw_uid != daemon.pw_uid
        for path in (home, program):
            os.chown(path, daemon.pw_uid, daemon.pw_gid)
        assert boot.choose_user(str(program)) == "daemon"
    finally:
        shutil.rmtree(home)


def test_units_that_have_changed_are_started_again(systemd: Systemd) -> None:
    systemd.show("rmpa.service", _RUNS)
    boot._start(Machine("", dry=False), ["rmpa.service", "rmpa-web.service"], ["rmpa.service"])
    assert systemd.calls() == [
        "systemctl daemon-reload",
        "systemctl enable rmpa.service",
        "systemctl restart rmpa.service",
        "systemctl enable --now rmpa-web.service",
    ]
    systemd.show("rmpa-web.service", _RUNS)
    boot._start(Machine("", dry=False), ["rmpa.service", "rmpa-web.service"], [])
    assert systemd.calls() == []


def test_a_unit_that_does_not_start_is_an_error_with_its_log(systemd: Systemd) -> None:
    (systemd.place / "rmpa.service.fails").touch()
    with pytest.raises(
        RmpaError, match=r"Job for rmpa.service failed.\n  info    agent     = base, domain 0: peers can find it"
    ):
        boot._start(Machine("", dry=False), ["rmpa.service"], [])


def test_status(systemd: Systemd, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(boot, "RUNTIME", str(systemd.place))
    said = ""
    for agent, web in (
        ("", ""),
        (_RUNS, _RUNS.replace("enabled", "disabled") + "NRestarts=2\n"),
        ("LoadState=loaded\nActiveState=inactive\nSubState=dead\nUnitFileState=disabled\n", ""),  # the package's
        ("LoadState=loaded\nActiveState=failed\nSubState=failed\nUnitFileState=enabled\nResult=watchdog\n", ""),
    ):
        gateway = agent and _RUNS.replace("enabled", "disabled").replace("=active", "=inactive")  # a package has it
        for unit, text in (("rmpa", agent), ("rmpa-web", web), ("rmpa-gateway", gateway)):
            (systemd.place / f"{unit}.service.show").unlink(missing_ok=True)
            if text:
                systemd.show(f"{unit}.service", text)
        code = main(["service", "status"])
        out, err = capsys.readouterr()
        said += f"$ rmpa service status\n{out}{err}exit code {code}\n\n"
    compare("boot_status", said)
    assert main(["service", "status", "--json"]) == 1
    unit = json.loads(capsys.readouterr().out)["units"][0]
    assert unit.pop("since") >= 7500
    assert unit == {
        "unit": "rmpa.service",
        "installed": True,
        "active": "failed",
        "sub": "failed",
        "enabled": True,
        "set_up": True,
        "result": "watchdog",
        "pid": None,
        "restarts": 0,
        "log": ["info    agent     = base, domain 0: peers can find it"],
    }


@pytest.mark.usefixtures("systemd")
def test_what_it_needs_is_said_in_one_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert main(["service", "install", "--web"]) == 1
    problem = "rmpa: rmpa service install: only root may change the machine; sudo /opt/rmpa/bin/rmpa service install"
    assert capsys.readouterr().err == f"{problem} [root-needed]\n"
    monkeypatch.setattr(units, "_BOOTED", tmp_path / "none")
    for verb in ("install", "status", "uninstall"):
        assert main(["service", verb]) == 1
        assert capsys.readouterr().err.startswith(
            f"rmpa: rmpa service {verb}: this machine was not started by systemd"
        )


def test_a_command_of_a_user_who_may_not_ask_the_unit_says_how_to(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = tmp_path / "run"
    place.mkdir(mode=0o750)
    monkeypatch.setattr(control_client, "_SYSTEM", place)
    monkeypatch.setattr(os, "access", lambda *_: False)
    monkeypatch.setenv("RMPA_RUNTIME_DIR", str(tmp_path / "none"))
    assert main(["peer", "list"]) == 1
    assert "use sudo; or once: sudo usermod -aG" in capsys.readouterr().err


def test_root_s_commands_mean_the_unit_s_state(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setattr(module_name, "_AT_BOOT", tmp_path / "rmpa.service")
    assert module_name.of_unit({}) == {}
    (tmp_path / "rmpa.service").symlink_to("/etc/systemd/system/rmpa.service")
    assert module_name.of_unit({}) == {"RMPA_STATE_DIR": "/var/lib/rmpa"}
    assert module_name.of_unit({"RMPA_STATE_DIR": "/mine"}) == {"RMPA_STATE_DIR": "/mine"}
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert module_name.of_unit({}) == {}
