"""RMPA: ROS 1 modules with a core of their own that share topics, with no master between them."""

import sys

if sys.version_info < (3, 11):  # noqa: UP036 - a clone on the PYTHONPATH of an older one; 2.7 can read this file too
    _text = "rmpa needs Python 3.11 or later, and {} is {}; bundle and Debian package have one: docs/start/install.md"
    # A program says one line; an import fails as any other.
    _error = SystemExit if sys.argv[:1] == ["-m"] else ImportError
    raise _error(_text.format(sys.executable, sys.version.split()[0]))

try:  # what a build wrote down (setup.py)
    from rmpa._build import COMMIT, DATE, VERSION  # type: ignore[import-not-found, unused-ignore]
except ImportError:  # a clone, on its way to the release that CHANGELOG.md begins with
    VERSION, COMMIT, DATE = "0.2.0.dev0", "", ""

__version__ = str(VERSION)
__all__ = ["COMMIT", "DATE", "VERSION", "__version__"]
