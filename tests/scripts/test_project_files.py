"""The project's files and the scripts that read them."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Final

import pytest
import yaml

ROOT: Final = Path(__file__).parents[2]
TEMPLATES: Final = sorted((ROOT / ".github/ISSUE_TEMPLATE").glob("[!c]*.yml"))


def test_the_changelog_has_the_form_that_a_release_is_cut_from() -> None:
    text = (ROOT / "CHANGELOG.md").read_text()
    assert len(text.splitlines()) <= 80 or len(re.findall(r"^## ", text, re.MULTILINE)) > 1
    for title in re.findall(r"^## (.*)$", text, re.MULTILINE):
        assert re.fullmatch(r"\[\d+\.\d+\.\d+\] - (\d{4}-\d\d-\d\d|unreleased)", title), title


@pytest.mark.parametrize("path", TEMPLATES, ids=lambda path: path.stem)
def test_issue_templates_are_forms(path: Path) -> None:
    form = yaml.safe_load(path.read_text())
    assert {"name", "description", "body"} <= form.keys()
    asked = [part for part in form["body"] if part["type"] != "markdown"]
    assert len({part["id"] for part in asked}) == len(asked)
    for part in form["body"]:
        assert part["type"] in {"markdown", "textarea", "input", "dropdown", "checkboxes"}
        assert part["attributes"]["value" if part["type"] == "markdown" else "label"]


def test_the_citation_is_of_this_program_and_its_paper() -> None:
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert cited["cff-version"] == "1.2.0"
    assert {"title", "message", "authors"} <= cited.keys()
    assert cited["license"] == (
        project["license"] if isinstance(project["license"], str) else project["license"]["text"]
    )
    assert [(one["title"], one["type"]) for one in cited["references"]] == [
        ("Distributed Real-time Control Architecture for ROS-based Modular Robots", "article")
    ]


def test_the_wheel_has_every_page_that_help_texts_and_remedies_name() -> None:
    shipped = {
        str(page.relative_to(ROOT))
        for patterns in tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"][
            "data-files"
        ].values()
        for pattern in patterns
        for page in ROOT.glob(pattern)
    }
    text = "".join(path.read_text() for path in (ROOT / "src/rmpa").rglob("*") if path.suffix in {".py", ".toml"})
    named = set(re.findall(r"\bdocs/(?!design/|compare/)[\w/-]+\.md", text))
    assert len(named) > 10
    assert named <= shipped


ROOT_vendor_web = Path(__file__).parents[2]


def test_the_committed_libraries_are_those_that_the_script_names() -> None:
    done = subprocess.run(
        [sys.executable, ROOT_vendor_web / "scripts/vendor-web", "--check"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_each_library_has_its_licence() -> None:
    for folder in ("src/rmpa/web/static/vendor", "tests/web/browser/vendor", "packaging/site/theme/assets"):
        names = {path.name for path in (ROOT_vendor_web / folder).iterdir()}
        for library, licences in {
            "htm-preact.js": {"htm.LICENSE", "preact.LICENSE"},
            "uPlot.js": {"uPlot.LICENSE"},
            "axe.min.js": {"axe.LICENSE"},
            "iframe-worker.js": {"iframe-worker.LICENSE"},
        }.items():
            if library in names:
                assert licences <= names


_ROOT: Final = Path(__file__).parents[2]
_OLD: Final = ("2.7", "3.6", "3.8", "3.10")


def python(version: str) -> str:
    """The program of a Python: on PATH, or pyenv's."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    for found in (shutil.which(f"python{version}"), *pyenv.glob(f"{version}.*/bin/python")):
        # A shim of pyenv is there for versions that are not chosen, too.
        if found and subprocess.run([found, "-c", ""], capture_output=True, check=False).returncode == 0:
            return str(found)
    pytest.skip(f"there is no Python {version}")


def run(*command: str | Path, cwd: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    env = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1", **variables}
    return subprocess.run(command, cwd=cwd, env=env, capture_output=True, text=True, check=False, timeout=50)


@pytest.mark.parametrize("version", _OLD)
def test_a_clone_on_the_path_of_an_older_python(tmp_path: Path, version: str) -> None:
    old = python(version)
    done = run(old, "-m", "rmpa", "up", cwd=tmp_path, PYTHONPATH=str(_ROOT / "src"))
    said = done.stderr.splitlines()
    assert done.returncode == 1
    assert re.search(rf"rmpa needs Python 3.11 or later, and /\S+ is {version}\.", said[-1])
    assert "docs/start/install.md" in said[-1]
    assert len(said) == 1 or version == "2.7"  # its runpy adds a traceback
    caught = "try: import rmpa.resource\nexcept ImportError as error: print(error)"
    done = run(old, "-c", caught, cwd=tmp_path, PYTHONPATH=str(_ROOT / "src"))
    assert done.stdout.strip() in said[-1]
    assert done.stdout.startswith("rmpa needs")


@pytest.mark.parametrize("version", ["3.8", "3.10"])
def test_pip_of_an_older_python_in_a_clone(tmp_path: Path, version: str) -> None:
    options = "--disable-pip-version-check", "--no-build-isolation", "--no-index", "--target", tmp_path
    done = run(python(version), "-m", "pip", "install", *options, _ROOT, cwd=tmp_path)
    assert done.returncode == 1
    assert f"rmpa needs Python 3.11 or later, and this is {version}." in done.stderr
    assert "docs/start/install.md" in done.stderr


def test_pip_of_an_older_python_does_not_look_for_our_libraries() -> None:
    project = tomllib.loads((_ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    for requirement in (*project["dependencies"], *extras["web"], *extras["zenoh"], *extras["trust"]):
        assert requirement.endswith("; python_version>='3.11'")


def test_the_package_is_the_program(tmp_path: Path) -> None:
    assert run(sys.executable, "-m", "rmpa", "--version", cwd=tmp_path).stdout.startswith("rmpa ")


_SCRIPT = Path(__file__).parents[2] / "scripts" / "run-tests"
_FAILS_ONCE = """
from pathlib import Path

def test_fails_at_its_first_run():
    mark = Path(__file__).with_name("ran")
    first = not mark.exists()
    mark.touch()
    assert not first
"""
_ALONE = """
import os, pytest

@pytest.mark.alone
def test_measures():
    assert "PYTEST_XDIST_WORKER" not in os.environ
"""
_PASSES = "def test_passes(): pass"


@pytest.mark.parametrize(
    ("texts", "code", "said"),
    [
        ([_PASSES, _ALONE], 0, "1 passed"),
        ([_PASSES, _FAILS_ONCE], 0, "PASSED test_1.py::test_fails_at_its_first_run"),
        ([_PASSES, "def test_fails(): assert False"], 1, "FAILED test_1.py::test_fails"),
        ([_FAILS_ONCE, "import nothing_of_this_name"], 2, "nothing_of_this_name"),
    ],
    ids=["passes", "flaky", "fails twice", "cannot be read"],
)
def test_run(tmp_path: Path, texts: list[str], code: int, said: str) -> None:
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = alone\n")
    for number, text in enumerate(texts):
        (tmp_path / f"test_{number}.py").write_text(text)
    env = {key: value for key, value in os.environ.items() if not key.startswith("PYTEST_")}
    done = subprocess.run(
        [_SCRIPT, sys.executable, "1"], cwd=tmp_path, env=env, capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == code, done.stdout
    assert said in done.stdout
