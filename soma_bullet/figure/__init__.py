"""From the drawing of a figure to a plan: which pieces fill it, on which side it stands, and which packing
can be built."""
