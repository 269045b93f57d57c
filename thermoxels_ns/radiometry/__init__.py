"""Converts the files of thermal cameras to degrees Celsius."""
