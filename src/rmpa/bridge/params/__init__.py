"""Parameters across modules: which may be read, set and followed, and how they cross."""
