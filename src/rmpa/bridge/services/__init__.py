"""Services across modules: which of them cross, where they are provided, and the calls between modules."""
