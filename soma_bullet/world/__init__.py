"""The world as its users see it: what a simulator offers, how it is set up, and the log of what happened."""
