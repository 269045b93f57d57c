"""Finds where the thermal camera sits beside the visible camera, and how the thermal camera's readings drift."""
