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
        assert f"rmpa\\-{family}\\fR(1)" in pages["rmpa.1.gz"]
    for setting in SETTINGS:
        name = setting.title if setting.is_list_of_tables or not setting.key else setting.key[-1]
        assert name in pages["rmpa.toml.5.gz"]


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
    run("shellcheck", *(tree / "DEBIAN" / name for name in ("postinst", "prerm", "postrm")))


@pytest.mark.packages
@pytest.mark.timeout(900)
@pytest.mark.skipif(not shutil.which("lintian"), reason="there is no lintian")
def test_lintian_finds_no_error_in_what_users_get() -> None:
    if (package := ways.package()) is None:
        pytest.skip("no package in dist: make deb")
    run("lintian", "--fail-on", "error", "--allow-root", package)
