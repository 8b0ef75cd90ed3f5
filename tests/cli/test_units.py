"""The texts of what runs RMPA at boot."""

from __future__ import annotations

import re
import shutil
import subprocess
import tomllib
from typing import TYPE_CHECKING

import pytest

from rmpa.cli.units import config_text, realtime_text, unit_texts
from rmpa.config.settings import SETTINGS
from tests.core.example import EXAMPLE

if TYPE_CHECKING:
    from pathlib import Path

# Of `systemd-analyze security`, in tenths; 0 is best. docs/guides/running.md#at-boot says what makes it up.
_EXPOSURE = {"rmpa.service": 20, "rmpa-web.service": 20, "rmpa-gateway.service": 20}


def test_the_first_configuration_has_every_line_of_the_example_and_sets_nothing() -> None:
    assert not any(tomllib.loads(config_text()).get(table) for table in ("core", "mesh", "web", "log"))
    _, _, settings = config_text().partition("#\n")  # behind what is said of the file
    _, _, example = EXAMPLE.read_text().partition("#\n")
    assert [line.removeprefix("# ") for line in settings.splitlines()] == [
        line.removeprefix("# ") for line in example.splitlines()
    ]


def test_each_variable_of_ours_is_one() -> None:
    texts = [*unit_texts().values(), realtime_text()]
    assert set(re.findall(r"\b(RMPA_\w+)=", "".join(texts))) <= {setting.env for setting in SETTINGS}


@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="there is no systemd-analyze")
def test_systemd_takes_every_line_and_finds_little_exposed(tmp_path: Path) -> None:
    for name, text in unit_texts(shutil.which("true") or "").items():
        (tmp_path / name).write_text(text)
    drop_in = tmp_path / "rmpa.service.d" / "realtime.conf"
    drop_in.parent.mkdir()
    drop_in.write_text(realtime_text())
    units = [tmp_path / name for name in _EXPOSURE]
    done = subprocess.run(["systemd-analyze", "verify", *units], capture_output=True, text=True, check=False)
    assert not [line for line in done.stderr.splitlines() if "rmpa" in line], done.stderr
    for unit in units:
        limit = f"--threshold={_EXPOSURE[unit.name]}"
        done = subprocess.run(
            ["systemd-analyze", "security", "--offline=true", limit, unit],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.stderr:  # systemd-analyze before 250 has no --offline; in some containers it cannot begin
            pytest.skip(done.stderr)
        assert done.returncode == 0, done.stdout
