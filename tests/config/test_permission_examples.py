"""The examples of permissions in docs/guides/trust.md are read, and `rmpa trust check` says what the page says."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from click.testing import CliRunner

from rmpa.cli.trust import trust_check
from rmpa.config.peer_rules import NAME_KEYS, Access
from rmpa.config.read import load_settings

PAGE = (Path(__file__).parents[2] / "docs/guides/trust.md").read_text("utf-8")
DOCUMENT = PAGE.partition("\n## Permissions\n")[2].partition("\n## ")[0]
EXAMPLES = re.findall(r"```toml\n(.*?)```", DOCUMENT, re.DOTALL)
CHECKS = re.findall(r"(?m)^\$ rmpa trust check (.*)\n(.*)$", DOCUMENT)


@pytest.mark.parametrize("text", EXAMPLES, ids=range(len(EXAMPLES)))
def test_each_example_is_read(text: str, tmp_path: Path) -> None:
    (tmp_path / "rmpa.toml").write_text(text)
    loaded = load_settings({}, {}, host_name="base", cwd=tmp_path)
    assert loaded.notes == ()
    trust = loaded.settings.trust
    assert trust.rules or trust.direct


@pytest.mark.parametrize(("words", "answer"), CHECKS)
def test_what_is_said_of_the_first_example_is_so(words: str, answer: str, tmp_path: Path) -> None:
    file = tmp_path / "rmpa.toml"
    file.write_text(EXAMPLES[0])
    result = CliRunner().invoke(trust_check, [*shlex.split(words), "--config", str(file)])
    assert result.output.strip() == answer
    assert result.exit_code == (0 if answer.startswith("yes") else 1)


def test_every_key_and_every_counter_is_named() -> None:
    keys = re.findall(r"(?m)^\| `(\w+)` \|", DOCUMENT)
    assert sorted(keys) == sorted(NAME_KEYS)
    counters = set(re.findall(r"`permission\.(\w+)`", DOCUMENT))
    assert counters == {*(str(access) for access in Access), "relay"}
    assert len(CHECKS) >= 4
