"""Services across the mesh: which stand where, and the calls between them."""
