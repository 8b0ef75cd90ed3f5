"""RMPA: ROS 1 modules with a core of their own that share topics, with no master between them.

What ``__all__`` of ``rmpa``, ``rmpa.client`` and ``rmpa.resource`` has is the Python API, which
``docs/reference/compatibility.md`` promises; every other name is private. The names are imported at their first use,
and ``__init__.pyi`` has their types.
"""

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

_MODULES = {
    "rmpa.core.errors": ["ConfigError", "PeerRefused", "RmpaError", "UnreachableError"],
    "rmpa.ros.node.node": ["Node", "Publisher", "Received", "Service", "ServiceClient", "Subscriber"],
    "rmpa.ros.node.service_client": ["ServiceFailed"],
    "rmpa.ros.types.definitions": ["DefinitionError"],
    "rmpa.ros.types.installed": ["ServiceType"],
    "rmpa.ros.types.messages": ["MessageError", "MessageType"],
    "rmpa.sync": ["SyncNode", "SyncPublisher", "connect"],
}
_LAZY = {name: module for module, names in _MODULES.items() for name in names}
__all__ = [
    "COMMIT",
    "DATE",
    "VERSION",
    "ConfigError",
    "DefinitionError",
    "MessageError",
    "MessageType",
    "Node",
    "PeerRefused",
    "Publisher",
    "Received",
    "RmpaError",
    "Service",
    "ServiceClient",
    "ServiceFailed",
    "ServiceType",
    "Subscriber",
    "SyncNode",
    "SyncPublisher",
    "UnreachableError",
    "__version__",
    "connect",
]


def __getattr__(name):
    """Import a name of the API at its first use."""
    if name not in _LAZY:
        raise AttributeError("module 'rmpa' has no attribute " + repr(name))  # Python 2.7 reads this file too
    import importlib  # noqa: PLC0415 - most programs that import rmpa need no more of it

    return getattr(importlib.import_module(_LAZY[name]), name)
