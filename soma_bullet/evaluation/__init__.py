"""How often it works, and which of two works better: many episodes, their lines, their summary, their
comparison."""
