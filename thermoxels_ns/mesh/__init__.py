"""From a density lattice to a tetrahedral mesh: numpy in, numpy out."""
