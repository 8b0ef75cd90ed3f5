"""What the JavaScript of the pages computes, by the test runner of node."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from typing import Final

import pytest

from tests.interop import npm

PAGES: Final = Path(__file__).parents[1] / "pages"
STATIC: Final = Path(__file__).parents[3] / "src/rmpa/web/static"


@pytest.mark.skipif(bool(npm.why_not()), reason=npm.why_not())
def test_what_the_pages_compute(tmp_path: Path) -> None:
    (tmp_path / "package.json").write_text('{"type": "module"}')
    shutil.copytree(STATIC, tmp_path / "static")
    file = shutil.copy(PAGES / "pages.test.mjs", tmp_path)
    done = subprocess.run(["node", "--test", file], check=False, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr
