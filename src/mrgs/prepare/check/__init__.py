"""Whether a scene that was made elsewhere can be trained on, and what is wrong with it."""

from mrgs.prepare.check.check import PAGE, check_scene
from mrgs.prepare.check.problems import Problem, SceneCheck, Severity

__all__ = ["PAGE", "Problem", "SceneCheck", "Severity", "check_scene"]
