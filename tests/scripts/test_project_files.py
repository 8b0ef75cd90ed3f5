"""The files about the project itself: they fit their forms; tests/docs has the rules for pages."""

from __future__ import annotations

import re
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
