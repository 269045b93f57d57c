"""Isosurface stuffing: tetrahedra that follow the surface."""
