"""The ways to install of docs/start/install.md, as a user types them; what is to be installed is in dist/."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import pytest

from tests.packages.machines import CLONE, Machine

USER: Final = "robot"
DIST: Final = CLONE / "dist"
# Seconds for one command that installs: more than a user is to wait, so that a figure is there in any case.
_PATIENCE: Final = 180.0
# The system's; uv has a set of its own, which knows no proxy of this network.
_CERTIFICATES: Final = "/etc/ssl/certs/ca-certificates.crt"
# What /opt/ros/noetic/setup.bash sets, with the places that Debian's ROS has.
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


def _newest(pattern: str) -> Path | None:
    return max(DIST.glob(pattern), key=lambda path: path.stat().st_mtime, default=None)


def package(arch: str = "amd64") -> Path | None:
    """The newest Debian package in dist/."""
    return _newest(f"rmpa_*_{arch}.deb")


def bundle(arch: str = "x86_64") -> Path | None:
    """The newest bundle in dist/."""
    return _newest(f"rmpa-*-linux-{arch}.tar.xz")


def wheel() -> Path | None:
    """The newest wheel in dist/."""
    return _newest("rmpa-*.whl")


def install_package(machine: Machine, file: str) -> str:
    """``sudo apt install ./rmpa_*.deb``."""
    machine.run("apt-get", "update", "-q", online=True, timeout=_PATIENCE)
    machine.run("apt-get", "install", "-y", "-q", file, online=True, timeout=_PATIENCE)
    return "rmpa"


def purge(machine: Machine) -> list[str]:
    """``sudo apt purge rmpa``; return what it leaves: files outside of /tmp and homes, users and groups."""
    machine.run("apt-get", "purge", "-y", "-q", "rmpa", timeout=_PATIENCE)
    words = ["/", "-xdev"]
    for folder in ("/home", "/root", "/tmp"):
        words += ["-path", folder, "-prune", "-o"]
    files = machine.run("find", *words, "-name", "*rmpa*", "-print").split()
    accounts = (machine.run("getent", "passwd") + machine.run("getent", "group")).splitlines()
    return files + [line for line in accounts if "rmpa" in line]


def unpack_bundle(machine: Machine, file: str) -> str:
    """``tar xf``, without root."""
    machine.run("tar", "xf", file, user=USER, timeout=_PATIENCE)
    return f"{file.removesuffix('.tar.xz')}/rmpa"


def install_by_pip(machine: Machine, file: str) -> str:
    """Into a virtual environment of the system's own Python."""
    machine.run("python3", "-m", "venv", ".rmpa", user=USER, timeout=_PATIENCE)
    pip = [".rmpa/bin/pip", "install", "-q", f"{file}[record,web,zenoh,trust]"]
    machine.run(*pip, user=USER, online=True, timeout=_PATIENCE)
    return ".rmpa/bin/rmpa"


def install_by_uv(machine: Machine, file: str) -> str:
    """``uv tool install``, with uv from PyPI and a Python from 3.12 on that is there; it cannot fetch one here."""
    machine.run("python3", "-m", "venv", ".uv", user=USER, timeout=_PATIENCE)
    machine.run(".uv/bin/pip", "install", "-q", "uv", user=USER, online=True, timeout=_PATIENCE)
    python = "3.13"
    if machine.suite == "bookworm":  # has 3.11; as if somebody had put a newer one there
        python = f"{machine.bind(_python_312())}/bin/python3.12"
    tool = [".uv/bin/uv", "tool", "install", "-q", "--python", python, f"{file}[record,web,zenoh,trust]"]
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
        install: Does it with a file, and returns the program.
        suites: The releases of the machines.
        product: The file that is installed, if it was made.
        made_by: The command that makes this file.
        env: What the shell of the user has set.
        boot: Whether ``sudo rmpa service install`` starts the agent, and not ``rmpa up`` in a terminal.
    """

    name: str
    install: Callable[[Machine, str], str]
    suites: tuple[str, ...]
    product: Callable[[], Path | None]
    made_by: str
    env: Mapping[str, str] = field(default_factory=dict)
    boot: bool = False


WAYS: Final = (
    Way("deb", install_package, ("bullseye", "trixie", "bookworm"), package, "make deb"),
    Way("bundle", unpack_bundle, ("bullseye", "bookworm", "trixie"), bundle, "make bundle", NOETIC),
    Way("pip", install_by_pip, ("bookworm", "trixie"), wheel, "make wheel"),
    Way("uv", install_by_uv, ("trixie", "bookworm"), wheel, "make wheel"),
    Way("deb at boot", install_package, ("bookworm", "bullseye", "trixie"), package, "make deb", boot=True),
    Way("bundle at boot", unpack_bundle, ("trixie", "bullseye"), bundle, "make bundle", NOETIC, boot=True),
    Way("pip at boot", install_by_pip, ("trixie", "bookworm"), wheel, "make wheel", boot=True),
)
