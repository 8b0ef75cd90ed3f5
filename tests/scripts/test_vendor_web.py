"""The libraries of the pages are those that scripts/vendor-web names, by SHA-256."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_committed_libraries_are_those_that_the_script_names() -> None:
    done = subprocess.run(
        [sys.executable, ROOT / "scripts/vendor-web", "--check"], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_each_library_has_its_licence() -> None:
    for folder in ("src/rmpa/web/static/vendor", "tests/web/browser/vendor", "packaging/site/theme/assets"):
        names = {path.name for path in (ROOT / folder).iterdir()}
        for library, licences in {
            "htm-preact.js": {"htm.LICENSE", "preact.LICENSE"},
            "uPlot.js": {"uPlot.LICENSE"},
            "axe.min.js": {"axe.LICENSE"},
            "iframe-worker.js": {"iframe-worker.LICENSE"},
        }.items():
            if library in names:
                assert licences <= names
