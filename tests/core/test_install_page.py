"""docs/start/install.md says how RMPA is installed, and from where; README and tutorial, by files of a release."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

_ROOT: Final = Path(__file__).parents[2]
_PAGE: Final = _ROOT / "docs/start/install.md"
_FROM_A_FILE: Final = '"$(ls $PWD/rmpa-*.whl)[web,zenoh,trust]"'
_INSTALLS: Final = re.compile(r"(?:pip3?|pipx|uv tool) install [^`\n]*")


def test_no_other_page_installs_rmpa_from_an_index() -> None:
    for page in (_ROOT / "README.md", *_ROOT.glob("docs/**/*.md"), *_ROOT.glob("packaging/**/*.md")):
        found = _INSTALLS.findall(page.read_text(encoding="utf-8"))
        found = [words for words in found if re.search(r"\brmpa\b", words)]
        assert all(words.endswith(_FROM_A_FILE) for words in found), page
        assert not found or page.name in {"README.md", "two-robots.md"}, page


def test_it_says_once_where_the_wheel_is() -> None:
    text = _PAGE.read_text(encoding="utf-8")
    assert len(re.findall(r"^\$ RMPA=", text, re.MULTILINE)) == 1
    commands = [words for words in _INSTALLS.findall(text) if "-c constraints" not in words]
    assert len(commands) == 3
    assert all('"$RMPA[web,zenoh,trust]"' in words for words in commands)
