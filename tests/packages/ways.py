"""The ways to install of docs/install.md, as a user types them; what is to be installed is in dist/."""

from __future__ import annotations

import functools
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest

from tests.packages.machines import CLONE

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from tests.packages.machines import Machine

USER: Final = "robot"
_PATIENCE: Final = 180.0
"""Seconds for one command that installs: more than a user is to wait, so that a figure is there in any case."""
_CERTIFICATES: Final = "/etc/ssl/certs/ca-certificates.crt"
"""The system's; uv has a set of its own, which knows no proxy of this network."""
NOETIC: Final = {
    "ROS_DISTRO": "noetic",
    "ROS_ETC_DIR": "/etc/ros",
    "ROS_PACKAGE_PATH": "/usr/share",
    "ROS_PYTHON_VERSION": "3",
    "ROS_VERSION": "1",
    "CMAKE_PREFIX_PATH": "/usr",
    "PYTHONPATH": "/usr/lib/python3/dist-packages",
    "LD_LIBRARY_PATH": "/usr/lib:/usr/lib/x86_64-linux-gnu",
}
"""What /opt/ros/noetic/setup.bash sets, with the places that Debian's ROS has."""


@functools.cache
def _version(*option: str) -> str:
    return subprocess.run(
        [sys.executable, CLONE / "scripts/version", *option], capture_output=True, text=True, check=True
    ).stdout.strip()


def package(arch: str = "amd64") -> Path:
    """The Debian package of this tree."""
    return CLONE / f"dist/rmpa_{_version('--deb')}_{arch}.deb"


def bundle(arch: str = "x86_64") -> Path:
    """The bundle of this tree."""
    return CLONE / f"dist/rmpa-{_version()}-linux-{arch}.tar.xz"


def wheel() -> Path:
    """The wheel of this tree."""
    return CLONE / f"dist/rmpa-{_version()}-py3-none-any.whl"


def install_package(machine: Machine) -> str:
    """``sudo apt install ./rmpa_*.deb``."""
    file = machine.put(package())
    machine.run("apt-get", "update", "-q", online=True, timeout=_PATIENCE)
    machine.run("apt-get", "install", "-y", "-q", file, online=True, timeout=_PATIENCE)
    return "rmpa"


def unpack_bundle(machine: Machine) -> str:
    """``tar xf``, without root."""
    machine.run("tar", "xf", machine.put(bundle(), USER), user=USER, timeout=_PATIENCE)
    return f"./{bundle().name.removesuffix('.tar.xz')}/rmpa"


def install_by_pip(machine: Machine) -> str:
    """Into a virtual environment of the system's own Python."""
    machine.run("python3", "-m", "venv", ".rmpa", user=USER, timeout=_PATIENCE)
    pip = [".rmpa/bin/pip", "install", "-q", f"{machine.put(wheel(), USER)}[web,zenoh,trust]"]
    machine.run(*pip, user=USER, online=True, timeout=_PATIENCE)
    return ".rmpa/bin/rmpa"


def install_by_uv(machine: Machine) -> str:
    """``uv tool install``, with uv from PyPI and a Python from 3.12 on that is there; it cannot fetch one here."""
    machine.run("python3", "-m", "venv", ".uv", user=USER, timeout=_PATIENCE)
    machine.run(".uv/bin/pip", "install", "-q", "uv", user=USER, online=True, timeout=_PATIENCE)
    python = "3.13"
    if machine.suite == "bookworm":  # has 3.11; as if somebody had put a newer one there
        python = f"{machine.bind(_python_312())}/bin/python3.12"
    tool = [".uv/bin/uv", "tool", "install", "-q", "--python", python, f"{machine.put(wheel(), USER)}[web,zenoh,trust]"]
    machine.run(*tool, user=USER, online=True, timeout=_PATIENCE, env={"SSL_CERT_FILE": _CERTIFICATES})
    return "rmpa"


def _python_312() -> Path:
    for place in (Path("~/.pyenv/versions").expanduser().glob("3.12.*"), [Path(sys.base_prefix)], [Path("/usr")]):
        for prefix in place:
            if (prefix / "bin/python3.12").exists():
                return prefix
    pytest.skip("no Python 3.12 here for uv on Debian 12")


@dataclass(frozen=True, slots=True)
class Way:
    """A way to install.

    Args:
        name: As the table of seconds calls it.
        install: Does it, and returns the program.
        suites: The releases of the machines.
        needs: The file that is installed.
        made_by: The command that makes this file.
        env: What the shell of the user has set.
    """

    name: str
    install: Callable[[Machine], str]
    suites: tuple[str, ...]
    needs: Callable[[], Path]
    made_by: str
    env: Mapping[str, str]


WAYS: Final = (
    Way("deb", install_package, ("bullseye", "trixie", "bookworm"), package, "make deb", {}),
    Way("bundle", unpack_bundle, ("bullseye", "bookworm", "trixie"), bundle, "make bundle", NOETIC),
    Way("pip", install_by_pip, ("bookworm", "trixie"), wheel, "make wheel", {}),
    Way("uv", install_by_uv, ("trixie", "bookworm"), wheel, "make wheel", {}),
)
