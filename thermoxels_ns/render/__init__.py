"""Ray sampling and compositing; knows fields only as callables."""
