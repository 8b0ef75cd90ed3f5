"""What pyproject.toml cannot say: the version comes from git's tag, and a build writes it down with its commit."""

import runpy
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py
from setuptools.command.sdist import sdist

ROOT = Path(__file__).resolve().parent
BUILD = runpy.run_path(str(ROOT / "scripts/version"))["build"](ROOT)


def write_down(package: Path) -> None:
    """Write ``_build.py`` into the package that is built; ``rmpa/__init__.py`` reads it."""
    lines = (f'{name} = "{value}"\n' for name, value in zip(("VERSION", "COMMIT", "DATE"), BUILD, strict=True))
    (package / "_build.py").write_text("".join(lines), encoding="ascii")


class BuildPackage(build_py):
    """Builds the package; an editable one is the clone itself, which has its commit from git."""

    def run(self) -> None:
        """Build, and write the version down."""
        super().run()
        if not self.editable_mode:
            write_down(Path(self.build_lib) / "rmpa")


class BuildSource(sdist):
    """Makes the source archive, of which wheels are built without git."""

    def make_release_tree(self, base_dir: str, files: list[str]) -> None:
        """Copy the files, and write the version down beside them."""
        super().make_release_tree(base_dir, files)
        write_down(Path(base_dir) / "src/rmpa")


setup(version=BUILD[0], cmdclass={"build_py": BuildPackage, "sdist": BuildSource})
