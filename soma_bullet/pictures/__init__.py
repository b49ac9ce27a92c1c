"""Films, stills, figures and exploded views."""
