"""Mesh files for other programs: writers for seven formats, and a reader for .vtu."""
