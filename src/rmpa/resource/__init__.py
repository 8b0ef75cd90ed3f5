"""Smart Resources: modules that offer services with a quality, and adapt (paper, section 3)."""
