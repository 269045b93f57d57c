"""Modules that all rooms may use: errors, checks, units, the lattice, and types that several rooms share."""
