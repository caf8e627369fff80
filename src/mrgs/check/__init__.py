"""Whether a scene that was made elsewhere can be trained, and its problems."""

from mrgs.check.check import check_scene
from mrgs.check.page import PAGE
from mrgs.check.problems import Problem, SceneCheck, Severity

__all__ = ["PAGE", "Problem", "SceneCheck", "Severity", "check_scene"]
