"""The formats and decisions of sites that Zenoh joins (docs/design/gateway.md); nothing here does I/O."""
