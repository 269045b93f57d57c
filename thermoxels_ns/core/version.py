"""The version of this package, apart from the root, which imports what asks for it."""

__version__ = "0.1.0"
