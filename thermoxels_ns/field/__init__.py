"""The voxel field: density, colour and temperature on lattice corners, and the background."""
