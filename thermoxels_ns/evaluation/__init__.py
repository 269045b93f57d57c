"""Comparison of a reconstruction with a synthetic scene whose shape and temperature are known."""
