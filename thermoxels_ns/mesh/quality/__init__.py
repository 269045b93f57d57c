"""Whether a mesh is fit for a finite-element solver."""
