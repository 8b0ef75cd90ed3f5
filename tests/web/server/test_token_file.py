"""The file of the token."""

from __future__ import annotations

import stat
from typing import TYPE_CHECKING

import pytest

from rmpa.config.settings import WebSettings
from rmpa.core.errors import StartError
from rmpa.web.server.access import token_from
from rmpa.web.server.process import access_of, url_of

if TYPE_CHECKING:
    from pathlib import Path


def test_a_token_is_made_once_for_its_owner_alone(tmp_path: Path) -> None:
    file = tmp_path / "base" / "web-token"
    token, is_new = token_from(file)
    assert is_new
    assert len(token) >= 43  # 256 bits
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert token_from(file) == (token, False)


def test_a_token_that_others_can_read_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "token"
    token_from(file)
    file.chmod(0o644)
    with pytest.raises(StartError, match=r"other users may use .*644.*chmod 600"):
        token_from(file)


@pytest.mark.parametrize(
    "text", ["", "short", "with spaces in the middle of it", "n" * 20 + "\x00", "\N{SNOWMAN}" * 20]
)
def test_a_file_without_a_token_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "token"
    file.write_text(text)
    file.chmod(0o600)
    with pytest.raises(StartError, match="holds no token"):
        token_from(file)


def test_loopback_needs_none_unless_a_file_is_given(tmp_path: Path) -> None:
    environ = {"RMPA_STATE_DIR": str(tmp_path)}
    assert access_of(WebSettings(), "base", environ).token == ""
    given = access_of(WebSettings(token_file=str(tmp_path / "mine")), "base", environ)
    assert given.token == (tmp_path / "mine").read_text().strip()


def test_beyond_loopback_the_token_is_made_and_its_url_told_once(tmp_path: Path) -> None:
    environ, web = {"RMPA_STATE_DIR": str(tmp_path)}, WebSettings(listen="192.168.1.7")
    first = access_of(web, "base", environ)
    assert first.file == tmp_path / "base" / "web-token"
    assert url_of(web, first, 8480) == f"http://192.168.1.7:8480/?token={first.token}"
    again = access_of(web, "base", environ)
    assert again.token == first.token
    assert first.token not in url_of(web, again, 8480)


def test_without_a_place_for_the_token_the_remedy_is_told() -> None:
    with pytest.raises(StartError, match="--token-file"):
        access_of(WebSettings(listen="192.168.1.7"), "base", {})
