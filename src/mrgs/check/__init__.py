"""Problems of a scene: one list of rules for ``check``, ``train`` and ``prepare``."""

from mrgs.check.problem import Problem, Severity
from mrgs.check.rules import fast_problems, warn_of_problems

__all__ = ["Problem", "Severity", "fast_problems", "warn_of_problems"]
