"""Scenes × methods: train, score, and write the paper's tables and figures."""

from mrgs_compare.comparison import Comparison, compare
from mrgs_compare.plan import DEFAULT_METHODS, Options, Variant

__all__ = ["DEFAULT_METHODS", "Comparison", "Options", "Variant", "compare"]
