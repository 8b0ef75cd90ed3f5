"""The report of a run directory: what it says, what it leaves out, and that the same samples give the same bytes."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest

from lab.bed.plan import Plan
from lab.experiments.report import write_report
from tests.lab.experiments.report.runs import Known, make_run

if TYPE_CHECKING:
    from pathlib import Path


def test_the_page_has_claims_figures_tables_and_the_manifest(tmp_path: Path) -> None:
    written = write_report(make_run(tmp_path / "run"), Known())
    page = written.markdown.read_text(encoding="utf-8")
    assert "Of 3 claims: 1 reached, 1 not reached, 1 with too few samples to say." in page
    row = "largest of RMPA / classic | ≤ 1.1 | 2 | 1.9 | ✗ **not reached** |"
    assert f"| [rates](#2-latency-against-rate-fig-10) | {row}" in page
    assert "| R² of the fit | ≥ 0.99 | - |  | ? too few samples to say |" in page
    assert "| largest of RMPA | ≤ 5 ms | 3 ms |  | ✓ reached |" in page
    assert "## 2. Latency against rate (Fig. 10)" in page
    assert "Messages are **counted**." in page
    assert "[![Fig. 10: latency \\| rate](figures/fig-10-rates.png)](figures/fig-10-rates.svg)" in page
    assert "Lower is better. Boxes: quartiles" in page
    assert "| RMPA | 2 |" in page
    assert "- Look at the p99." in page
    assert "| rates | 40 | 60 | - | - | 75.5 |" in page
    assert "rmpa experiment run --out 'a run'" in page
    assert "| cpu | Some \\| CPU |" in page
    assert "short run" not in page
    assert "from node to node" not in page
    assert "Incomplete" not in page
    assert written.missing == ""
    assert [path.name for path in written.figures] == ["fig-10-rates.png", "fig-10-rates.svg"]
    assert list(written.findings) == ["rates"]


def test_the_same_samples_give_the_same_bytes(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")

    def contents() -> dict[str, bytes]:
        written = write_report(run, Known())
        return {path.name: path.read_bytes() for path in (written.html, written.markdown, *written.figures)}

    assert contents() == contents()


@pytest.mark.parametrize(
    ("plan", "said"),
    [(Plan(size="short"), "short run")],
)
def test_the_page_warns_of_what_cannot_be_quoted(tmp_path: Path, plan: Plan, said: str) -> None:
    written = write_report(make_run(tmp_path / "run", plan=plan), Known())
    (warning,) = re.findall(r"^> (.*)", written.markdown.read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert said in warning


def test_the_page_says_what_could_not_be_measured(tmp_path: Path) -> None:
    written = write_report(make_run(tmp_path / "run", names=("rmpa",), fail=True), Known())
    page = written.markdown.read_text(encoding="utf-8")
    assert "> **Incomplete**: 1 cell could not be measured." in page
    assert "- system classic, round 1: no answer \\<script\\>" in page
    page = write_report(make_run(tmp_path / "next", names=("rmpa",)), Known()).markdown.read_text(encoding="utf-8")
    assert "> **Incomplete**: 1 cell not measured yet." in page
