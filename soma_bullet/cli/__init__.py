"""The command lines: typed options, progress on stderr, exit status for scripts."""
