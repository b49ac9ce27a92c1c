"""The executive: segments are started, watched, corrected, tried again, or planned anew."""
