"""A Gaussian blur of learned width."""
