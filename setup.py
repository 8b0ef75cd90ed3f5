"""What pyproject.toml cannot say: version and commit, links for readers elsewhere, a word for older Pythons."""

import re
import runpy
import sys
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py
from setuptools.command.sdist import sdist

if sys.version_info < (3, 11):  # noqa: UP036 - pip runs this file before it looks at requires-python
    sys.exit(
        f"rmpa needs Python 3.11 or later, and this is {sys.version.split()[0]}: take another (python3.12 -m pip) "
        "or RMPA's bundle or Debian package, which bring one: docs/start/install.md"
    )
ROOT = Path(__file__).resolve().parent
VERSION = runpy.run_path(str(ROOT / "scripts/version"))
BUILD = VERSION["build"](ROOT)


def url() -> str:
    """Where the repository is published."""
    import tomllib  # noqa: PLC0415 - the Pythons that are refused above have none

    return str(tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["rmpa"]["url"])


def readme() -> str:
    """README.md as an index of packages shows it: its links and pictures are those of the repository."""

    def absolute(link: re.Match[str]) -> str:
        kind = "raw" if link[1].endswith((".png", ".svg")) else "blob"
        return f"]({url()}/{kind}/HEAD/{'README.md' if link[1].startswith('#') else ''}{link[1]})"

    return re.sub(r"\]\((?!\w+:)([^)\s]+)\)", absolute, (ROOT / "README.md").read_text(encoding="utf-8"))


def write_down(package: Path) -> None:
    """Write ``_build.py`` into the package that is built; ``rmpa/__init__.py`` reads it."""
    (package / "_build.py").write_text(VERSION["module"](*BUILD), encoding="ascii")


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


setup(
    version=BUILD[0],
    long_description=readme(),
    long_description_content_type="text/markdown",
    project_urls={
        "Source": url(),
        "Documentation": f"{url()}/blob/HEAD/docs/start/install.md",
        "Changelog": f"{url()}/blob/HEAD/CHANGELOG.md",
        "Issues": f"{url()}/issues",
    },
    cmdclass={"build_py": BuildPackage, "sdist": BuildSource},
)
