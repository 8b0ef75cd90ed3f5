"""Workspaces on disk, as users of ROS have them."""

from __future__ import annotations

from pathlib import Path

import pytest

from rmpa.ros.types import installed


def nothing_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No ROS is found but what a test puts to ``opt``, and no package is known yet."""
    monkeypatch.setattr(installed, "_DISTRIBUTIONS", tmp_path / "opt")
    monkeypatch.setattr(installed, "_SYSTEM", ())
    monkeypatch.delenv("PYTHONPATH", raising=False)
    installed.packages_below.cache_clear()


def package(folder: Path, name: str = "", **files: str) -> Path:
    """Make a package: ``msg_Pose="float64 x"`` is its file ``msg/Pose.msg``."""
    folder.mkdir(parents=True, exist_ok=True)
    declared = f"<package><!-- <name>old</name> --><name>{name or folder.name}</name></package>"
    (folder / "package.xml").write_text(declared)
    for key, text in files.items():
        kind, _, base = key.partition("_")
        (folder / kind).mkdir(exist_ok=True)
        (folder / kind / f"{base}.{kind}").write_text(text)
    return folder
