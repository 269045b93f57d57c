"""Choice of the solid voxels of a trained field, and the level whose zero is their surface."""
