"""Which photos of a folder belong together."""
