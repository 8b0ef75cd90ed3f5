"""The roles that the docs list are those that there are."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from rmpa.core.errors import ConfigError
from rmpa.resource.declare.resource import Resource, Role

_PAGE = Path(__file__).parents[2] / "docs" / "smart-resources.md"


def test_the_docs_list_the_roles() -> None:
    section = _PAGE.read_text(encoding="utf-8").partition("## Roles\n")[2].partition("\n## ")[0]
    assert re.findall(r'^\| `"(\w+)"` \|', section, re.MULTILINE) == list(Role)


@pytest.mark.parametrize("role", list(Role))
def test_each_can_be_declared(role: str) -> None:
    assert Resource("sonar", role=role).role is Role(role)


def test_another_one_is_refused_with_the_list() -> None:
    with pytest.raises(ConfigError, match="sensing, acting, controlling"):
        Resource("sonar", role="watching-tv")
