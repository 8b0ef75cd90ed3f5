"""``[[web_token]]``: what it may say, and what a user is told who says something else."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from rmpa.config.sources import load_settings
from rmpa.config.web_tokens import WebRole, WebToken
from rmpa.core.errors import ConfigError

if TYPE_CHECKING:
    from pathlib import Path


def _load(tmp_path: Path, text: str) -> tuple[WebToken, ...]:
    path = tmp_path / "rmpa.toml"
    path.write_text(text)
    return load_settings({"config": str(path)}, {}, host_name="robot", cwd=tmp_path).settings.web_tokens


def test_a_client_only_looks_unless_its_token_says_more(tmp_path: Path) -> None:
    text = """
        [trust.groups]
        operators = ["joystick"]
        [[web_token]]
        name = "wall"
        [[web_token]]
        name = "tablet"
        role = "operator"
        groups = ["operators"]
        file = "/etc/tablet.token"
        [[web_token]]
        name = "boss"
        role = "admin"
    """
    assert _load(tmp_path, text) == (
        WebToken("wall", WebRole.VIEWER),
        WebToken("tablet", WebRole.OPERATOR, ("operators",), "/etc/tablet.token"),
        WebToken("boss", WebRole.ADMIN),
    )


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ('role = "viewer"', r"a rule without name.*one has name = .tablet."),
        ('name = "a b"', r"rmpa\.toml:2: web_token"),
        ('name = "a"\nrole = "operater"', r"rmpa\.toml:3: .*operator"),
        ('name = "a"\ngroups = ["operators"]', r"there is no group 'operators'; make it in \[trust.groups\]"),
        ('name = "a"\n[[web_token]]\nname = "a"', r"there are two tokens of a"),
        ('name = "a"\nrights = "all"', r"rights"),
        ("\n[[web_token]]\n".join(f'name = "n{number}"' for number in range(65)), r"65 tokens; at most 64"),
    ],
)
def test_what_is_wrong_is_told_with_its_line(tmp_path: Path, text: str, told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        _load(tmp_path, f"[[web_token]]\n{text}\n")
