"""The names that users import, and those of earlier releases."""

from __future__ import annotations

import importlib
import sys

import pytest

import rmpa.resource
from rmpa.resource import Demand, QoSRequest, RequirementAnswer, Resource, ResourceClient, at_least
from rmpa.ros.node.node import Node


def test_every_public_name_is_found() -> None:
    assert all(getattr(rmpa.resource, name) for name in rmpa.resource.__all__)
    assert rmpa.resource.Node is Node
    assert ResourceClient.__module__ == "rmpa.resource.run.client"


@pytest.mark.parametrize(("old", "new"), [("Wish", QoSRequest), ("Answer", RequirementAnswer)])
def test_renamed_classes_warn(old: str, new: type) -> None:
    with pytest.warns(DeprecationWarning, match=f"{old} is deprecated: it is called {new.__name__} now"):
        assert getattr(rmpa.resource, old) is new


@pytest.mark.parametrize(("name", "new"), [("Resource", Resource), ("at_least", at_least), ("Wish", QoSRequest)])
def test_names_of_the_declare_module_warn(name: str, new: object) -> None:
    declare = importlib.import_module("rmpa.resource.declare")
    with pytest.warns(DeprecationWarning, match="from rmpa.resource"):
        assert getattr(declare, name) is new


def test_former_node_module_warns() -> None:
    sys.modules.pop("rmpa.ros.aio.node", None)
    with pytest.warns(DeprecationWarning, match=r"rmpa\.ros\.aio\.node is deprecated"):
        assert importlib.import_module("rmpa.ros.aio.node").Node is Node


def test_wishes_of_a_demand_warn() -> None:
    requests = {"rate": at_least("5 Hz")}
    with pytest.warns(DeprecationWarning, match="called requests now"):
        assert Demand("/sonar", requests).wishes is requests


@pytest.mark.parametrize("module", ["rmpa.resource", "rmpa.resource.declare"])
def test_unknown_names_are_attribute_errors(module: str) -> None:
    with pytest.raises(AttributeError, match="Wishes"):
        getattr(importlib.import_module(module), "Wishes")  # noqa: B009 - the type checker knows it is not there
