"""The planner's verdicts on stability held against those of others: contact physics, and compas-cra's rigid
blocks."""
