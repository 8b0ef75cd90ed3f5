"""The names that users import."""

from __future__ import annotations

import pytest

import rmpa.resource
from rmpa.resource import ResourceClient
from rmpa.ros.node.node import Node


def test_every_public_name_is_found() -> None:
    assert all(getattr(rmpa.resource, name) for name in rmpa.resource.__all__)
    assert rmpa.resource.Node is Node
    assert ResourceClient.__module__ == "rmpa.resource.run.client"


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="Wishes"):
        getattr(rmpa.resource, "Wishes")  # noqa: B009 - the type checker knows it is not there
