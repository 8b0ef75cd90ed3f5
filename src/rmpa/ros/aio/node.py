"""The former place of ``rmpa.ros.Node``, for programs that import it from here."""

from __future__ import annotations

import warnings

from rmpa.ros.node.node import Node, Publisher, Received, Service, ServiceClient, Subscriber

__all__ = ["Node", "Publisher", "Received", "Service", "ServiceClient", "Subscriber"]

warnings.warn("rmpa.ros.aio.node is deprecated: use `from rmpa.ros import Node`", DeprecationWarning, stacklevel=2)
