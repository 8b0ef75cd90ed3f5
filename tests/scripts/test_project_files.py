"""The files about the project itself: they fit their forms, and name commands and pages that are there."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Final

import pytest
import yaml

from rmpa.cli.main import VERBS

ROOT: Final = Path(__file__).parents[2]
PAGES: Final = (
    "CHANGELOG.md",
    "SECURITY.md",
    "CODE_OF_CONDUCT.md",
    "CONTRIBUTING.md",
    "README.md",
    "docs/reference/compatibility.md",
    "docs/start/install.md",
    "docs/guides/troubleshooting.md",
)
TEMPLATES: Final = sorted((ROOT / ".github/ISSUE_TEMPLATE").glob("[!c]*.yml"))


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_to_files_and_headings(page: str) -> None:
    text = (ROOT / page).read_text()
    for name, heading in re.findall(r"\]\((?!https?:)([^)#]*)(?:#([^)]*))?\)", text):
        there = (ROOT / page).parent / name if name else ROOT / page
        assert there.exists(), name
        if heading:
            titles = re.findall(r"^#+ (.*)$", there.read_text(), re.MULTILINE)
            anchors = {re.sub(r"[^\w\- ]", "", title).strip().lower().replace(" ", "-") for title in titles}
            assert heading in anchors, f"{name}#{heading}"


@pytest.mark.parametrize("page", [*PAGES, *(str(path.relative_to(ROOT)) for path in TEMPLATES)])
def test_commands_that_are_named_are_there(page: str) -> None:
    named = re.findall(r"(?:`|: )rmpa ((?:[a-z]+ ?)+)", (ROOT / page).read_text())
    assert [words for words in named if words.split()[0] not in {verb.split()[0] for verb in VERBS}] == []


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
