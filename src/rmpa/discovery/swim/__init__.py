"""SWIM: failure detection by probes, and news that spread with them. Sans-I/O (docs/design/protocol.md)."""
