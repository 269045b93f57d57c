"""Finds camera poses from photographs by structure from motion, the scale of the model, and up."""
