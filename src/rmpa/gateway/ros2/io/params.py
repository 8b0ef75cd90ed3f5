"""Parameters: those of modules at nodes of ROS 2's graph, and those of ROS 2's nodes in the gateway's tree."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.gateway.ros2.graph import OWN_NAMESPACE
from rmpa.gateway.ros2.io.module_params import ModuleParams
from rmpa.gateway.ros2.io.node_params import NodeParams
from rmpa.gateway.ros2.params import PACKAGE, ParamTypes
from rmpa.gateway.ros2.tokens import EntityKind

if TYPE_CHECKING:
    from rmpa.gateway.neighbour import MeshSource
    from rmpa.gateway.ros2.io.module_params import AskModule
    from rmpa.gateway.ros2.io.node_params import ParamTree
    from rmpa.gateway.ros2.io.part import Ros2Context
    from rmpa.gateway.ros2.tokens import Ros2Endpoint


class Ros2Params:
    """Joins parameters both ways.

    Args:
        ask: Asks a linked module about its parameters.
        tree: The gateway's own parameters.
    """

    def __init__(self, ask: AskModule, tree: ParamTree) -> None:
        self._ask = ask
        self._tree = tree
        self._context: Ros2Context | None = None
        self._types: ParamTypes | None = None
        self._nodes: NodeParams | None = None
        self._modules: dict[str, ModuleParams] = {}
        self._sources: dict[str, int] = {}

    def start(self, context: Ros2Context) -> None:
        """Begin."""
        self._context = context
        self._types = ParamTypes(context.types)
        self._nodes = NodeParams(context, self._types, self._tree)

    def mesh_source(self, source: MeshSource, *, there: bool) -> bool:
        """Offer the parameters of a module while any source of it is there; the source is left to other parts."""
        count = self._sources.get(source.module, 0) + (1 if there else -1)
        if count > 0:
            self._sources[source.module] = count
        else:
            self._sources.pop(source.module, None)
        self._judge(source.module)
        return False

    def rival(self, node: str) -> None:
        """Of the gateways that show the node of a module one answers for its parameters."""
        module = node.removeprefix(OWN_NAMESPACE)
        if module in self._sources:
            self._judge(module)

    def _judge(self, module: str) -> None:
        """Offer the parameters of a module, or take them back."""
        context, types = self._context, self._types
        if context is None or types is None:
            return
        wanted = module in self._sources and _may_be_a_node(module)
        if wanted and not context.ros2.led_by(OWN_NAMESPACE + module):
            if module not in self._modules:
                self._modules[module] = ModuleParams(context, types, module, self._ask)
        elif (gone := self._modules.pop(module, None)) is not None:
            gone.close()

    def endpoint(self, endpoint: Ros2Endpoint, *, there: bool) -> bool:
        """Take the services of rcl_interfaces; *get_parameters* stands for all of a node."""
        if endpoint.type.partition("/")[0] != PACKAGE or endpoint.kind is not EntityKind.SERVICE:
            return False
        if self._nodes is not None and endpoint.name == f"{endpoint.node.name}/get_parameters":
            if there:
                self._nodes.appeared(endpoint.node.name)
            else:
                self._nodes.gone(endpoint.node.name)
        return True

    def close(self) -> None:
        """Take back all services."""
        for each in self._modules.values():
            each.close()
        self._modules.clear()
        if self._nodes is not None:
            self._nodes.close()

    def report(self) -> dict[str, object]:
        """The modules whose parameters ROS 2 has, and the nodes of ROS 2 with the number of theirs."""
        nodes = {} if self._nodes is None else self._nodes.report()
        return {"params_out": sorted(self._modules), "params_in": nodes}


def _may_be_a_node(module: str) -> bool:
    """Whether ROS 2 allows a node of a module's name."""
    return module.replace("_", "a").isalnum() and module.isascii() and not module[0].isdigit()
