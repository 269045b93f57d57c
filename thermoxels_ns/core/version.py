"""The version of this package, in a module of its own because the package root imports modules that need it."""

__version__ = "0.1.0"
