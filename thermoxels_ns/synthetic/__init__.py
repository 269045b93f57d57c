"""Scenes drawn by formula, whose shape and temperature are known exactly."""
