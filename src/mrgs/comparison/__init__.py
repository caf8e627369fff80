"""Scenes × methods: train, score, and write the paper's tables and figures."""

from mrgs.comparison.comparison import Comparison, compare
from mrgs.comparison.plan import DEFAULT_METHODS, Options, Variant

__all__ = ["DEFAULT_METHODS", "Comparison", "Options", "Variant", "compare"]
