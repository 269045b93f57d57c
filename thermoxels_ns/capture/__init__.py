"""Converts a folder of camera files to a scene that the dataparser reads."""
