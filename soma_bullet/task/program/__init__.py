"""Actions become timed segments."""
