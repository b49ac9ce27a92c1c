"""Judges an episode by its log and the assembly, without a simulator."""
