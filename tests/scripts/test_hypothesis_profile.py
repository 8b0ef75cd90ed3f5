"""The profile of Hypothesis that tests/conftest.py loads holds, whatever the environment says."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

PROGRAM = """
from hypothesis import settings
import tests.conftest
print(settings.get_current_profile_name(), settings(max_examples=7).deadline)
"""


def test_no_example_has_a_deadline() -> None:
    assert settings.get_current_profile_name() == "rmpa"
    assert settings(max_examples=7).deadline is None
    assert HealthCheck.too_slow in settings().suppress_health_check


@pytest.mark.parametrize("variables", [{}, {"CI": "true"}])
def test_it_wins_over_the_profile_of_a_build_server(variables: dict[str, str]) -> None:
    env = {name: value for name, value in os.environ.items() if name != "CI"} | variables
    root = Path(__file__).parents[2]
    argv = [sys.executable, "-c", PROGRAM]
    told = subprocess.run(argv, capture_output=True, text=True, check=True, env=env, cwd=root, timeout=50)
    assert told.stdout.split() == ["rmpa", "None"]
