"""Trained runs: registry of methods, runs to be rendered from, models baked for other programs."""
