"""Whether this installation and this machine can do the job, check by check."""
