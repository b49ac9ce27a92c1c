"""What an episode reports: figures of merit, for people and for files."""
