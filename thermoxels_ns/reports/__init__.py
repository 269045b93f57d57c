"""Pages, charts and pictures; no physics."""
