"""User pages tell what there is: no plans, no history, no places that are still to be written."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

import pytest

from tests.docs.pages import USER_PAGES, name_of

if TYPE_CHECKING:
    from pathlib import Path

_REFUSED: Final = re.compile(
    r"""\b(?: not\ yet | as\ yet | no\ longer(?!\ than) | (?:the|a)\ plan(?:s|\ is)? | (?:is|are)\ planned
    | road\ ?map | TODO | FIXME | TBD | coming\ soon | in\ (?:the|a)\ (?:near\ )?future
    | in\ a\ later\ (?:version|release)
    | for\ the\ time\ being | currently | at\ the\ moment | nowadays | used\ to\ be | previously | formerly
    | will\ be\ (?:added|supported|removed|possible|available) | since\ (?:version\ )?0\.\d | is\ being\ written
    )\b""",
    re.VERBOSE | re.IGNORECASE,
)

_ALL_TOGETHER: Final = 39_000
"""Words that the user pages may have, those aside that are made from code."""
_MADE: Final = re.compile(r"^<!-- tables: begin.*?^<!-- tables: end -->$", re.MULTILINE | re.DOTALL)

_UNSEEN: Final = re.compile(r"<!--.*?-->", re.DOTALL)


@pytest.mark.parametrize("page", USER_PAGES, ids=name_of)
def test_a_user_page_tells_what_there_is(page: Path) -> None:
    text = re.sub(r"```.*?```", lambda block: "\n" * block[0].count("\n"), page.read_text("utf-8"), flags=re.DOTALL)
    found = [
        f"{number}: {said[0]}" for number, line in enumerate(text.splitlines(), 1) for said in _REFUSED.finditer(line)
    ]
    assert found == []


def test_the_user_pages_are_read_in_an_evening() -> None:
    words = {
        name_of(page): len(_UNSEEN.sub("", _MADE.sub("", page.read_text("utf-8"))).split()) for page in USER_PAGES
    }
    assert sum(words.values()) <= _ALL_TOGETHER, sorted(words.items(), key=lambda each: -each[1])
