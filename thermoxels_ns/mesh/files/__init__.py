"""Mesh files for other programs: writers for five formats, and a reader for .vtu."""
