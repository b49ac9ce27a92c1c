"""The dual-arm task: where the pieces are fed, who picks, inserts and holds what, and the program of segments
that follows."""
