"""Where the thermal camera sits beside the visible one, and how its reading drifts."""
