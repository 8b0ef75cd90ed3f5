"""Workspaces on disk, as users of ROS have them."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path


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
