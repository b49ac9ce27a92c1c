"""Which actions in which order: candidates, limits, regrasps, rearrangement."""
