"""Construction of a tetrahedral mesh from a trained field; inputs and outputs are numpy arrays."""
