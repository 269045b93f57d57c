"""Html pages, charts and pictures of results; this package computes no results of its own."""
