"""Rays to pixels: sampling, compositing and their compiled twins."""
