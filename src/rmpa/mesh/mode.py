"""Whether this agent keeps a link to each peer, or only those that something depends on. Pure."""

from __future__ import annotations

from rmpa.config import limits as config_limits
from rmpa.core.links import Links
from rmpa.mesh import limits


class MeshMode:
    """Decides by the number of modules, with hysteresis, so that a mesh of about the limit's size does not flicker.

    Each agent decides for itself. Two agents may differ for a moment: a link is only parked while both sides agree.

    Args:
        links: The word of ``[mesh] links``.
        full_mesh_up_to: With ``Links.AUTO``: the modules, this one included, up to which all links stay.
    """

    def __init__(self, links: Links = Links.AUTO, full_mesh_up_to: int = config_limits.FULL_MESH_MODULES) -> None:
        self._links = links
        self._limit = full_mesh_up_to
        self.modules = 1
        """The modules that are present, this one included."""
        self.demand = links is Links.DEMAND
        """Whether links stand on demand; else each peer stays linked."""

    def count(self, modules: int) -> bool:
        """Take the number of modules that are present, this one included; return whether the mode has changed."""
        self.modules = modules
        before = self.demand
        if self._links is Links.AUTO:
            if modules > self._limit:
                self.demand = True
            elif modules < self._limit * limits.FULL_MESH_AGAIN or modules == 1:
                self.demand = False
        return self.demand != before

    @property
    def reason(self) -> str:
        """Why the mode is what it is, for users: the words behind "full mesh" or "links on demand"."""
        if self._links is not Links.AUTO:
            return f'mesh.links = "{self._links}"'
        if not self.demand:
            return f"{_modules(self.modules)}, mesh.full_mesh_up_to = {self._limit}"
        if self.modules > self._limit:
            return f"{_modules(self.modules)}, more than mesh.full_mesh_up_to = {self._limit}"
        below = f"until there are fewer than {self._limit * limits.FULL_MESH_AGAIN:g}"
        return f"{_modules(self.modules)}, there were more than mesh.full_mesh_up_to = {self._limit}; {below}"

    def __str__(self) -> str:
        """``full mesh (3 modules, mesh.full_mesh_up_to = 64)``."""
        return f"{'links on demand' if self.demand else 'full mesh'} ({self.reason})"


def _modules(count: int) -> str:
    return f"{count} module{'' if count == 1 else 's'}"
