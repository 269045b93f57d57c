"""Which part of space is solid."""
