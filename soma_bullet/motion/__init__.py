"""Motion of one arm: straight lines of the hand, transfers around obstacles (OMPL), and their timing
(toppra)."""
