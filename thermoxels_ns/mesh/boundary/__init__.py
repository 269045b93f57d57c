"""The boundary of a mesh: patches of triangles, and the cameras that see them."""
