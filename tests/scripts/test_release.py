"""make release: what it refuses, and what it puts together, with builds that stand in for the long ones."""

from __future__ import annotations

import hashlib
import json
import os
import re
import runpy
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path
from typing import Any, Final

import pytest

ROOT: Final = Path(__file__).parents[2]
pytestmark = pytest.mark.git
CHANGELOG: Final = "# Changelog\n\nAll.\n\n## [0.2.0] - 2026-11-26\n\nFirst words.\n\n### Added\n\n* a\n"
MAKEFILE: Final = """\
.PHONY: wheel bundle deb
V := $(shell PYTHON scripts/version)
wheel:
\tmkdir -p dist; echo $(SALT)wheel > dist/rmpa-$V-py3-none-any.whl; echo sdist > dist/rmpa-$V.tar.gz
bundle:
\tmkdir -p dist; cp -r bundle dist/rmpa-$V-linux-$(ARCH); echo $(ARCH) > dist/rmpa-$V-linux-$(ARCH).tar.xz
deb:
\techo $(ARCH) > dist/rmpa_$V_$(ARCH).deb
""".replace("PYTHON", sys.executable)
WHEELS: Final = {
    "rmpa-0.2.0": "Name: rmpa\nVersion: 0.2.0",
    "click-8.1": "Name: click\nVersion: 8.1\nLicense-Expression: BSD-3-Clause",
    "Old_One-1": "Name: Old_One\nVersion: 1\nClassifier: License :: OSI Approved :: MIT License",
}
TEXTS: Final = "ELF;v3.12.7;OpenSSL 3.5.4 30 Sep 2025;SQLite format 3;3.14.9;3.46.1;no liblzma;5.8.1;expat_2.7.1"


class Clone:
    """A repository that may be released."""

    def __init__(self, folder: Path) -> None:
        self.root = folder / "clone"
        self.release = self.root / "dist/release-0.2.0"
        for name in ("scripts/version", "scripts/release", "src/rmpa/__init__.py"):
            (self.root / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, self.root / name)
        site = self.root / "bundle/python/lib/python3.12/site-packages"
        files = {
            "Makefile": MAKEFILE,
            "CHANGELOG.md": CHANGELOG,
            ".gitignore": "dist\n",
            "tests/golden/0.2.0.json": "{}",
            "pyproject.toml": '[tool.rmpa]\nurl = "https://example.org"\n',
        }
        files |= {
            f"{site}/{name}.dist-info/METADATA": f"Metadata-Version: 2.4\n{text}\n" for name, text in WHEELS.items()
        }
        for name, text in files.items():
            self.write(name, text)
        program = self.root / "bundle/python/bin/python3.12"
        program.parent.mkdir()
        program.write_bytes(b"\x7f" + TEXTS.encode().replace(b";", b"\0") + b"\0deflate 1.3.1 Copyright")
        me = {f"GIT_{who}_{what}": "a@b" for who in ("AUTHOR", "COMMITTER") for what in ("NAME", "EMAIL")}
        self.environment = {**os.environ, **me, "DEBEMAIL": "a@b", "RMPA_BUILD_CACHE": str(folder / "cache")}
        names = runpy.run_path(str(ROOT / "scripts/release"))
        mark = hashlib.sha256(names["VALIDATOR"].encode()).hexdigest()[:8]
        tool = folder / f"cache/validator-{mark}-{sys.version_info.minor}"
        self.write(f"{tool}/complete", "")
        self.write(f"{tool}/bin/python", '#!/bin/sh\nexec grep -q CycloneDX "$3"\n')
        (tool / "bin/python").chmod(0o755)
        self.git("init", "-q")
        self.git("add", ".")
        self.git("commit", "-qm", "one")
        self.git("tag", "v0.2.0")
        head = subprocess.check_output(["git", "rev-parse", "--short", "HEAD"], cwd=self.root, text=True).strip()
        told = {"code": {"commit": head, "changed": False}, "plan": {"size": "full"}}
        self.write("dist/experiment/manifest.json", json.dumps(told))
        self.write("dist/experiment/report/figures/a.svg", "<svg/>")

    def write(self, name: str, text: str) -> None:
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    def git(self, *words: str) -> None:
        subprocess.run(["git", *words], cwd=self.root, env=self.environment, check=True)

    def run(self, *, fails: bool = False, **variables: str) -> str:
        """What the script prints, or its error."""
        done = subprocess.run(
            [sys.executable, self.root / "scripts/release"],
            cwd=self.root,
            env=self.environment | variables,
            capture_output=True,
            text=True,
            check=False,
        )
        assert (done.returncode != 0) is fails, done.stderr
        return done.stderr if fails else done.stdout

    def bill(self, machine: str) -> Any:
        return json.loads((self.release / f"rmpa-0.2.0-linux-{machine}.cdx.json").read_text())


@pytest.fixture
def clone(tmp_path: Path) -> Clone:
    return Clone(tmp_path)


REFUSED: Final = {
    "2 files of the tree are not committed (Makefile, new)": "echo > new; echo > Makefile",
    "the last commit has no tag: git tag -a v0.2.1": "git commit -qm two --allow-empty",
    "the tree is 0.3.0, and CHANGELOG.md begins with 0.2.0": "git commit -qm two --allow-empty; git tag v0.3.0",
    "CHANGELOG.md says that 0.2.0 is unreleased": (
        "sed -i s/2026-11-26/unreleased/ CHANGELOG.md; git commit -qam two; git tag -f v0.2.0"
    ),
    "tests/golden/0.1.0.json is not what v0.1.0 had": (
        "echo 1 > tests/golden/0.1.0.json; git add .; git commit -qm two; git tag v0.1.0;"
        "echo 2 > tests/golden/0.1.0.json; git commit -qam three; git tag -f v0.2.0"
    ),
    "pyproject.toml does not say where RMPA is published": (
        "sed -i s/example.org/rmpa.invalid/ pyproject.toml; git commit -qam two; git tag -f v0.2.0"
    ),
    "dist/experiment has no report: sudo make experiment": "rm -r dist/experiment",
    "dist/experiment is no whole run of this code": (
        "mkdir src/x; echo > src/x/y; git add .; git commit -qm two; git tag -f v0.2.0"
    ),
    "tests/golden/0.2.0.json is missing": "git rm -q tests/golden/0.2.0.json; git commit -qm two; git tag -f v0.2.0",
}


@pytest.mark.parametrize(("why", "change"), REFUSED.items())
def test_a_tree_that_is_no_release_is_refused_in_one_line(clone: Clone, why: str, change: str) -> None:
    subprocess.run(change, shell=True, cwd=clone.root, env=clone.environment, capture_output=True, check=True)
    error = clone.run(fails=True)
    assert error.startswith(f"make release: {why}"), error
    assert error.count("\n") == 1
    assert not clone.release.exists()


def test_the_files_of_a_release_with_their_sums(clone: Clone) -> None:
    clone.run()
    names = {path.name for path in clone.release.iterdir()}
    assert names == {
        "rmpa-0.2.0-py3-none-any.whl",
        "rmpa-0.2.0.tar.gz",
        *(f"rmpa-0.2.0-linux-{machine}.{end}" for machine in ("x86_64", "aarch64") for end in ("tar.xz", "cdx.json")),
        *(f"rmpa_0.2.0_{machine}.deb" for machine in ("amd64", "arm64")),
        "rmpa-0.2.0-report.tar.xz",
        "NOTES.md",
        "SHA256SUMS",
    }
    with tarfile.open(clone.release / "rmpa-0.2.0-report.tar.xz") as packed:
        packed_names = [name.removeprefix("rmpa-0.2.0-report/") for name in packed.getnames()]
    assert packed_names == ["manifest.json", "report/figures", "report/figures/a.svg"]
    assert (clone.release / "NOTES.md").read_text() == "First words.\n\n### Added\n\n* a\n"
    checked = subprocess.run(
        ["sha256sum", "-c", "SHA256SUMS"], cwd=clone.release, capture_output=True, text=True, check=True
    )
    assert checked.stdout.count(": OK\n") == len(names) - 1


def test_a_second_run_says_what_differs(clone: Clone) -> None:
    clone.run()
    shutil.rmtree(clone.root / "dist/rmpa-0.2.0-linux-x86_64")
    shutil.rmtree(clone.root / "dist/rmpa-0.2.0-linux-aarch64")
    out = clone.run(SALT="other")
    assert re.findall(r"(\S+)  DIFFERS from the run before", out) == ["rmpa-0.2.0-py3-none-any.whl"]
    assert out.count("  as before") == 9


def test_the_bill_of_materials_has_wheels_interpreter_and_c_libraries(clone: Clone) -> None:
    clone.run()
    bill = clone.bill("aarch64")
    parts = {part["name"]: part for part in bill["components"]}
    versions = {name: part["version"] for name, part in parts.items()}
    assert versions == {
        "cpython": "3.12.7", "openssl": "3.5.4", "sqlite": "3.46.1", "xz": "5.8.1", "expat": "2.7.1", "zlib": "1.3.1",
        "click": "8.1", "old-one": "1",
    }  # fmt: skip
    assert parts["click"]["licenses"] == [{"expression": "BSD-3-Clause"}]
    assert parts["old-one"]["licenses"] == [{"license": {"name": "MIT License"}}]
    assert parts["openssl"]["properties"] == [{"name": "rmpa:in", "value": "python/bin/python3.12"}]
    assert bill["metadata"]["component"]["purl"] == "pkg:pypi/rmpa@0.2.0"
    assert bill["serialNumber"] != clone.bill("x86_64")["serialNumber"]


@pytest.mark.long
def test_the_bill_of_materials_fits_cyclonedx(clone: Clone, tmp_path: Path) -> None:
    shutil.rmtree(tmp_path / "cache")
    clone.run()
