"""Isosurface stuffing: tetrahedra whose boundary follows a level set, and sharpening of edges."""
