"""Topics across the mesh: the plans of what is offered, shown and routed, and the states of routes. Pure."""
