"""RGB and thermal photographs to a 3D model that a finite-element solver can run on."""

__version__ = "0.1.0"
