"""The Debian package around a bundle: what it has, and that its manual pages know every command."""

from __future__ import annotations

import gzip
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest

from rmpa.cli.main import VERBS
from rmpa.cli.units import UNITS
from rmpa.config.settings import SETTINGS
from tests.packages import ways

SCRIPTS: Final = ("preinst", "postinst", "prerm", "postrm")
BUILD: Final = Path(__file__).parents[2] / "packaging/debian/build"
pytestmark = pytest.mark.skipif(not shutil.which("dpkg-deb"), reason="there is no dpkg-deb")


def run(*command: str | Path, **options: object) -> str:
    done = subprocess.run(command, capture_output=True, text=True, check=False, **options)  # type: ignore[call-overload]
    assert done.returncode == 0, done.stdout + done.stderr
    return str(done.stdout)


def build(folder: Path, arch: str = "amd64") -> Path:
    """A package of a bundle that has only its program."""
    bundle = folder / "bundle"
    bundle.mkdir(parents=True)
    (bundle / "rmpa").write_text("#!/bin/sh\n")
    (bundle / "rmpa").chmod(0o755)
    run(sys.executable, BUILD, "--bundle", bundle, "--arch", arch, folder)
    return next(folder.glob(f"rmpa_*_{arch}.deb"))


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("package"))


@pytest.fixture(scope="module")
def tree(package: Path) -> Path:
    """The files of the package, its control files in DEBIAN/."""
    run("dpkg-deb", "-R", package, package.parent / "tree")
    return package.parent / "tree"


def test_the_same_bundle_and_commit_give_the_same_bytes(package: Path, tmp_path: Path) -> None:
    before = os.umask(0o077)
    try:
        assert build(tmp_path).read_bytes() == package.read_bytes()
    finally:
        os.umask(before)


def test_the_oldest_dpkg_reads_it_and_its_files_are_roots(package: Path) -> None:
    assert run("ar", "t", package).split() == ["debian-binary", "control.tar.xz", "data.tar.xz"]
    assert {line.split()[1] for line in run("dpkg-deb", "-c", package).splitlines()} == {"root/root"}


def test_an_arm64_package_is_built_on_any_machine(tmp_path: Path) -> None:
    fields = run("dpkg-deb", "-f", build(tmp_path, "arm64"), "Architecture", "Depends")
    assert "Architecture: arm64" in fields
    assert re.search(r"libc6 \(>= 2\.\d+\)", fields)


def test_program_units_and_configuration_are_where_the_system_looks(tree: Path) -> None:
    assert (tree / "usr/bin/rmpa").readlink() == Path("../lib/rmpa/rmpa")
    for unit in UNITS.values():
        assert "ExecStart=/usr/bin/rmpa " in (tree / "usr/lib/systemd/system" / unit).read_text()
    assert (tree / "DEBIAN/conffiles").read_text().split() == ["/etc/rmpa/rmpa.toml"]
    assert "# port = 11311" in (tree / "etc/rmpa/rmpa.toml").read_text()


def test_the_systems_python_is_told_which_one_has_rmpa(tree: Path) -> None:
    path = {**os.environ, "PYTHONPATH": str(tree / "usr/lib/python3/dist-packages")}
    command = [sys.executable, "-c", "import rmpa.resource"]
    done = subprocess.run(command, env=path, cwd="/", capture_output=True, text=True, check=False)
    assert done.returncode == 1
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"ImportError: RMPA is for a Python of its own, and this is {sys.executable}")
    assert "`rmpa run FILE`" in last
    assert "/usr/lib/rmpa/python/bin/python3" in last


def test_there_is_a_manual_for_every_command_and_setting(tree: Path) -> None:
    pages = {page.name: gzip.decompress(page.read_bytes()).decode() for page in tree.glob("usr/share/man/man?/*.gz")}
    for words, (module, _) in VERBS.items():
        family = words.partition(" ")[0]
        if module != "main":  # those are families
            assert f"\\fBrmpa {words}\\fR".replace("-", r"\-") in pages[f"rmpa-{family}.1.gz"], words
        assert f"rmpa-{family}\\fR(1)".replace("-", r"\-") in pages["rmpa.1.gz"]
    for setting in SETTINGS:
        name = setting.title if setting.is_list_of_tables or not setting.key else setting.key[-1]
        assert name in pages["rmpa.toml.5.gz"]
    for page in tree.rglob("*.gz"):
        head = page.read_bytes()[:10]
        assert (head[4:8], head[9]) == (bytes(4), 255), f"{page}: other bytes with another Python"


@pytest.mark.skipif(not shutil.which("man"), reason="there is no man")
def test_man_takes_every_line_of_the_manuals(tree: Path) -> None:
    for page in tree.glob("usr/share/man/man?/*.gz"):
        command = ["man", "--warnings", "-E", "UTF-8", "-l", "-Tutf8", "-Z", str(page)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (0, ""), page


def test_shells_find_the_completion(tree: Path) -> None:
    bash = tree / "usr/share/bash-completion/completions/rmpa"
    assert run("bash", "-c", f". {bash}; complete -p rmpa").split()[-1] == "rmpa"
    assert (tree / "usr/share/zsh/vendor-completions/_rmpa").read_text().startswith("#compdef rmpa\n")
    assert "complete" in (tree / "usr/share/fish/vendor_completions.d/rmpa.fish").read_text()


@pytest.mark.skipif(not shutil.which("shellcheck"), reason="there is no shellcheck")
def test_shellcheck_finds_nothing_in_the_maintainer_scripts(tree: Path) -> None:
    run("shellcheck", *(tree / "DEBIAN" / name for name in SCRIPTS))


class System:
    """A system in a folder, for maintainer scripts, with stubs of the programs that they call.

    Args:
        root: The folder.
        tree: The files of the package.
    """

    def __init__(self, root: Path, tree: Path) -> None:
        self.root, self.tree = root, tree
        self.put("run/systemd/system/is", "")
        for name in ("addgroup", "adduser", "deb-systemd-invoke", "groupdel", "install", "systemctl", "userdel"):
            self.stub(f"stubs/{name}")
        self.stub("stubs/getent", f"cat {root}/etc/$1")
        self.accounts()

    def put(self, name: str, text: str) -> Path:
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        return path

    def stub(self, name: str, does: str = "") -> None:
        """A program that writes down how it was called."""
        log = f'echo "${{0##*/}} $*" >>{self.root}/log\n' if not does else ""
        self.put(name, f"#!/bin/sh\n{log}{does}\n").chmod(0o755)

    def accounts(self, uid: int = 105, home: str = "/var/lib/rmpa") -> None:
        """Give it the user and the group rmpa."""
        self.put("etc/passwd", f"rmpa:x:{uid}:{uid}::{self.root}{home}:/bin/sh\n")
        self.put("etc/group", f"rmpa:x:{uid}:\n")

    def run(self, script: str, *words: str, status: int = 0) -> tuple[list[str], str]:
        """Run a maintainer script; return the programs that it has called, and its errors."""
        text = re.sub(
            r"(?<![\w.])/(?=(etc|run|usr|var)/)", f"{self.root}/", (self.tree / "DEBIAN" / script).read_text()
        )
        (self.root / "log").write_text("")
        path = {"PATH": f"{self.root}/stubs:{os.environ['PATH']}"}
        done = subprocess.run(
            ["sh", "-c", text, script, *words], env=path, capture_output=True, text=True, check=False
        )
        assert done.returncode == status, done.stderr
        return (self.root / "log").read_text().replace(str(self.root), "").splitlines(), done.stderr


@pytest.fixture
def system(tmp_path: Path, tree: Path) -> System:
    return System(tmp_path, tree)


BUNDLES: Final = "[Service]\nExecStart=/opt/rmpa/rmpa up --config /etc/rmpa/rmpa.toml\n"


def test_the_service_of_a_bundle_outlives_removal_and_purge(system: System) -> None:
    system.put("etc/systemd/system/rmpa.service", BUNDLES)
    settings, state = system.put("etc/rmpa/rmpa.toml", "mine"), system.put("var/lib/rmpa/module-name", "robot")
    drop_in = system.put("etc/systemd/system/rmpa.service.d/mine.conf", "")
    called, _ = system.run("prerm", "remove")
    assert "deb-systemd-invoke stop rmpa-web.service" in called
    assert not [call for call in called if "rmpa.service" in call]
    system.run("postrm", "remove")
    settings.unlink()  # as dpkg does before it calls purge
    called, said = system.run("postrm", "purge")
    assert said.count("\n") == 1
    assert "/etc/systemd/system/rmpa.service is not the package's" in said
    assert (settings.read_text(), state.read_text(), drop_in.exists()) == ("mine", "robot", True)
    assert list(settings.parent.iterdir()) == [settings]
    assert called == ["systemctl --system daemon-reload"]


def test_the_packages_own_service_goes_though_its_unit_was_edited(system: System) -> None:
    unit = system.put("etc/systemd/system/rmpa.service", "ExecStart=/usr/bin/rmpa up\n")
    unit.write_text(f"ExecStart={system.root}/usr/bin/rmpa up\n")
    system.put("etc/rmpa/rmpa.toml", "mine")
    called, _ = system.run("prerm", "remove")
    assert {"deb-systemd-invoke stop rmpa.service", "systemctl --quiet disable rmpa.service"} <= set(called)
    system.run("postrm", "remove")
    called, said = system.run("postrm", "purge")
    assert not (system.root / "etc/rmpa").exists()
    assert (called[:2], said) == (["userdel rmpa", "groupdel rmpa"], "")


def test_purge_removes_state_behind_a_link(system: System) -> None:
    kept = system.put("data/rmpa/module-name", "robot").parent
    link = system.root / "var/lib/rmpa"
    link.parent.mkdir(parents=True)
    link.symlink_to(kept)
    system.run("postrm", "purge")
    assert not link.is_symlink()
    assert not kept.exists()


@pytest.mark.parametrize(("uid", "home"), [(1000, "/var/lib/rmpa"), (105, "/home/rmpa")])
def test_purge_leaves_an_account_that_is_not_the_packages(system: System, uid: int, home: str) -> None:
    system.accounts(uid, home)
    called, _ = system.run("postrm", "purge")
    assert not {"userdel rmpa", "groupdel rmpa"} & set(called)


def test_a_user_that_cannot_be_removed_does_not_fail_the_purge(system: System) -> None:
    for name in ("userdel", "groupdel"):
        system.stub(f"stubs/{name}", "exit 8")
    assert "sudo userdel rmpa" in system.run("postrm", "purge")[1]


def test_a_login_account_of_its_name_is_told_before_anything_is_unpacked(system: System) -> None:
    system.run("preinst", "install")
    system.accounts(1000, "/home/rmpa")
    said = system.run("preinst", "install", status=1)[1]
    assert "usermod --login NEW rmpa" in said
    assert said.count("\n") == 1
    system.put("etc/passwd", "")
    assert "groupmod" in system.run("preinst", "install", status=1)[1]
    system.put("etc/group", "")
    system.run("preinst", "install")


def test_an_upgrade_asks_its_own_program_and_leaves_the_state_to_its_owner(system: System) -> None:
    system.stub("stubs/rmpa", "exit 1")  # a pip's, in /usr/local/bin
    system.stub("usr/bin/rmpa")
    made = "install -d -o rmpa -g rmpa -m 0700 /var/lib/rmpa"
    called, _ = system.run("postinst", "configure", "1.0")
    assert {made, "rmpa config show --config /etc/rmpa/rmpa.toml"} <= set(called)
    assert "deb-systemd-invoke try-restart rmpa.service" in called
    system.put("var/lib/rmpa/module-name", "robot")
    assert made not in system.run("postinst", "configure", "1.0")[0]


@pytest.mark.packages
@pytest.mark.timeout(900)
@pytest.mark.skipif(not shutil.which("lintian"), reason="there is no lintian")
def test_lintian_finds_no_error_in_what_users_get() -> None:
    if (package := ways.package()) is None:
        pytest.skip("no package in dist: make deb")
    run("lintian", "--fail-on", "error", "--allow-root", package)
