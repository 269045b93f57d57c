"""Mesh files of other programs."""
