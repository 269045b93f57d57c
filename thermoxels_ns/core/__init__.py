"""The ground floor: errors, checks, units, the lattice and the types that cross walls."""
