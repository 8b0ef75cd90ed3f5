"""The agent that every module runs: builds the rooms and wires them."""
