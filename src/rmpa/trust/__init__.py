"""Trust: which modules may join a mesh, and what each of them may do (docs/design/trust.md)."""
