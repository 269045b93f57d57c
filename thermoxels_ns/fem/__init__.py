"""Heat conduction on a tetrahedral mesh, in SI units."""
