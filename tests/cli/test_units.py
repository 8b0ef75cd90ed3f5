"""The texts of what runs RMPA at boot."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

from rmpa.cli.units import CONFIG, DROP_INS, config_text, drop_in_text, unit_texts
from rmpa.config.settings import SETTINGS
from tests.cli.conftest import Machine
from tests.core.example import EXAMPLE

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
    texts = [*unit_texts().values(), *map(drop_in_text, DROP_INS)]
    assert set(re.findall(r"\b(RMPA_\w+)=", "".join(texts))) <= {setting.env for setting in SETTINGS}


@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="there is no systemd-analyze")
def test_systemd_takes_every_line_and_finds_little_exposed(tmp_path: Path) -> None:
    for name, text in unit_texts(shutil.which("true") or "").items():
        (tmp_path / name).write_text(text)
    (tmp_path / "rmpa.service.d").mkdir()
    for option, name in DROP_INS.items():
        (tmp_path / name).write_text(drop_in_text(option))
    units = [tmp_path / name for name in _EXPOSURE]
    done = subprocess.run(["systemd-analyze", "verify", *units], capture_output=True, text=True, check=False)
    assert not [line for line in done.stderr.splitlines() if "rmpa" in line], done.stderr
    (tmp_path / DROP_INS["resources"]).unlink()  # it gives devices to the nodes
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


def reload_commands(unit: str, config: Path, pid: int) -> list[list[str]]:
    """What systemd runs to reload a unit, on the machine of a test."""
    program = f"{sys.executable} -m rmpa.cli.main"
    lines = re.findall(r"^ExecReload=(.*)$", unit_texts("PROGRAM")[unit], re.MULTILINE)
    texts = [line.replace("PROGRAM", program).replace(CONFIG, str(config)) for line in lines]
    return [text.replace("$MAINPID", str(pid)).split() for text in texts]


def test_a_reload_of_a_unit_fails_with_what_the_settings_lack(machines: Callable[[str], Machine]) -> None:
    """Of several agents here the unit's own is asked; the web server is not asked to read what it cannot use."""
    machine = machines("")
    config = machine.path / "rmpa.toml"

    def reload(unit: str, pid: int, settings: str) -> tuple[int, str]:
        config.write_text(settings)
        for words in reload_commands(unit, config, pid):
            done = subprocess.run(words, env=machine.environ, capture_output=True, text=True, check=False)
            if done.returncode:
                return done.returncode, done.stderr
        return 0, ""

    config.touch()
    process = machine.up("--config", str(config), "--name", "base")
    other = machine.up("--name", "arm")
    code, said = reload("rmpa.service", process.pid, "[bridge]\ndeny = 3\n")
    assert (code, f"{config}:2: bridge.deny" in said) == (2, True)
    code, said = reload("rmpa.service", process.pid, '[core]\nhost = "198.51.100.7"\n')
    assert (code, "this machine does not have that address" in said) == (2, True)
    assert reload("rmpa.service", process.pid, '[bridge]\ndeny = ["/secret"]\n') == (0, "")
    assert "settings read again: bridge.deny" in machine.log()
    assert other.poll() is None
    code, said = reload("rmpa-web.service", 0, '[web]\nkey = "/etc/key.pem"\n')
    assert (code, "there is a key without a certificate" in said) == (2, True)
    code, said = reload("rmpa-web.service", 0, '[web]\ncert = "/nowhere/cert.pem"\n')
    assert (code, "/nowhere/cert.pem: there is no such file" in said) == (1, True)
