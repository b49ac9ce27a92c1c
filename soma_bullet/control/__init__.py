"""Runs a program on any simulator: segments are started, guided, watched, corrected, tried again, or planned
anew."""
