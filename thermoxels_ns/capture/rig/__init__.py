"""Finds the rig (the thermal lens and its pose relative to the visible camera), and the drift of thermal readings."""
