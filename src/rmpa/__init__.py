"""RMPA: ROS 1 modules with a core of their own that share topics, with no master between them."""

try:  # what a build wrote down (setup.py)
    from rmpa._build import COMMIT, DATE, VERSION  # type: ignore[import-not-found, unused-ignore]
except ImportError:  # a clone, on its way to the release that CHANGELOG.md begins with
    VERSION, COMMIT, DATE = "0.2.0.dev0", "", ""

__version__: str = VERSION
__all__ = ["COMMIT", "DATE", "VERSION", "__version__"]
