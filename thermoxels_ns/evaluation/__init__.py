"""Comparison of a reconstruction with the truth."""
