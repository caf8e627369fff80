"""Trained runs: the registry of methods, runs opened to be rendered from, models baked for other
programs."""
