"""Camera poses from photographs by structure from motion, and their scale."""
