"""The report of a run directory: what it says, what it leaves out, and that the same samples give the same bytes."""

from __future__ import annotations

import base64
import re
from html.parser import HTMLParser
from typing import TYPE_CHECKING

import pytest

from lab.bed.plan import Plan
from lab.experiments.model import Cell
from lab.experiments.report import write_report
from lab.experiments.store import Store
from rmpa.core.errors import ConfigError
from tests.lab.experiments.report.runs import Known, Latencies, make_run

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
    assert "On loopback" not in page
    assert "Incomplete" not in page
    assert written.missing == ""
    assert [path.name for path in written.figures] == ["fig-10-rates.png", "fig-10-rates.svg"]
    assert list(written.findings) == ["rates"]


def test_a_run_with_direct_cells_says_what_that_is(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    Store.load(run).expect("rates", "", [Cell("rates", {"system": "rmpa", "transport": "direct", "round": 1})])
    page = write_report(run, Known()).markdown.read_text(encoding="utf-8")
    assert "*RMPA direct* is from node to node. Before and after" in page


class _Page(HTMLParser):
    """Collects what a browser would fetch, where links go and what they may go to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.sources: list[str] = []
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.tags: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        for name, value in attrs:
            if name == "src" and value:
                self.sources.append(value)
            if name == "href" and value:
                self.links.append(value)
            if name == "id" and value:
                self.anchors.add(value)


def test_html_is_one_file_whose_links_lead_somewhere(tmp_path: Path) -> None:
    written = write_report(make_run(tmp_path / "run", fail=True), Known())
    page = _Page(written.html.read_text(encoding="utf-8"))
    (source,) = page.sources
    head, _, data = source.partition(",")
    assert head == "data:image/svg+xml;base64"
    svg = next(path for path in written.figures if path.suffix == ".svg")
    assert base64.b64decode(data) == svg.read_bytes()
    assert page.links
    assert {link.removeprefix("#") for link in page.links} <= page.anchors
    assert "script" not in page.tags  # the error of the cell that failed is text
    assert "table" in page.tags


def test_the_same_samples_give_the_same_bytes(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")

    def contents() -> dict[str, bytes]:
        written = write_report(run, Known())
        return {path.name: path.read_bytes() for path in (written.html, written.markdown, *written.figures)}

    assert contents() == contents()


def test_figures_of_an_earlier_report_go(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    old = run / "report" / "figures" / "old.svg"
    old.parent.mkdir(parents=True)
    old.touch()
    written = write_report(run, Known())
    assert sorted(old.parent.iterdir()) == sorted(written.figures)


@pytest.mark.parametrize(
    ("plan", "said"),
    [(Plan(size="short"), "short run"), (Plan(bed="loopback", clients=("own",), link=""), "On loopback")],
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


def test_findings_that_fail_do_not_take_the_others_away(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    written = write_report(make_run(tmp_path / "run"), Known({"rates": Latencies(broken=True)}))
    assert "findings of rates (ZeroDivisionError: made so)" in written.missing
    assert "> **No findings**: ZeroDivisionError: made so" in written.markdown.read_text(encoding="utf-8")
    assert "rates: no findings" in caplog.text


def test_samples_that_are_gone_are_named(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    (run / "rates" / "system-rmpa_round-1" / "arrivals.csv").unlink()
    assert "arrivals.csv" in write_report(run, Known()).missing


def test_an_experiment_that_nobody_knows_any_more_is_named(tmp_path: Path) -> None:
    assert "no such experiment" in write_report(make_run(tmp_path / "run"), Known({})).missing


def test_what_is_no_run_directory_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError):
        write_report(tmp_path, Known())
    assert list(tmp_path.iterdir()) == []
