"""Former place of ``Node``, now ``rmpa.resource.Node``."""

from __future__ import annotations

import warnings

from rmpa.ros.node.node import Node
from rmpa.ros.node.topics import Received

__all__ = ["Node", "Received"]

warnings.warn("rmpa.ros.aio.node is deprecated: import Node from rmpa.resource", DeprecationWarning, stacklevel=2)
