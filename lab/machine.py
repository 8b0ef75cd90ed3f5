"""What the figures were measured on, and how much its scheduler adds by itself."""

from __future__ import annotations

import math
import os
import platform
import subprocess
import sysconfig
import time
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pandas as pd

from lab.experiments.code import code_here

if TYPE_CHECKING:
    from collections.abc import Sequence

# Upper bounds of the histogram's classes, in µs.
_BOUNDS: Final = (20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000)


def facts() -> dict[str, object]:
    """The machine, its kernel and the versions of what takes part."""
    return {
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "kernel": platform.release(),
        "system": platform.freedesktop_os_release().get("PRETTY_NAME", ""),
        "python": platform.python_version(),
        "python_optimised": _optimised(),
        "rmpa": version("rmpa"),
        "commit": code_here().commit,
        "roscpp": _output("dpkg-query", "-W", "-f", "${Version}", "libroscpp-dev"),
        "rospy": _output("dpkg-query", "-W", "-f", "${Version}", "python3-rospy"),
        "load": os.getloadavg(),
        "governor": _first_line(Path("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")),
    }


def lateness(seconds: float, period: float = 0.001) -> list[float]:
    """Sleep towards a fixed schedule; return how late each wake-up came, in µs."""
    late: list[float] = []
    due = time.perf_counter()
    for _ in range(int(seconds / period)):
        due += period
        time.sleep(max(0.0, due - time.perf_counter()))
        late.append((time.perf_counter() - due) * 1e6)
    return late


def histogram(late: Sequence[float]) -> dict[str, int]:
    """Count samples in µs by class, each named by its upper bound."""
    names = [*(f"≤{bound}" for bound in _BOUNDS), f">{_BOUNDS[-1]}"]
    classes = pd.cut(pd.Series(late, dtype="float64"), [-math.inf, *_BOUNDS, math.inf], labels=names)
    return {str(name): int(count) for name, count in classes.value_counts(sort=False).items()}


def _optimised() -> bool:
    """Whether this interpreter was built with profile-guided optimisation; one that was not is a third slower."""
    return "--enable-optimizations" in str(sysconfig.get_config_var("CONFIG_ARGS"))


def _cpu() -> str:
    for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.machine()


def _output(*argv: str) -> str:
    try:
        done = subprocess.run(argv, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return ""
    return done.stdout.strip()


def _first_line(path: Path) -> str:
    return path.read_text(encoding="utf-8").strip() if path.exists() else ""
