"""The words every room shares: identities, names, errors, limits, clocks, figures and settings."""
