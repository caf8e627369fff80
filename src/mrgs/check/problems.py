"""The result of a check."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

Severity = Literal["error", "warning", "note"]
"""Error: training fails, or the model will be wrong. Warning: the model will be worse. Note: may be
intended."""


@dataclass(frozen=True)
class Problem:
    """A problem of a scene.

    Attributes:
        severity: how wrong.
        text: what was found, a sentence.
        remedy: what to do about it, a sentence; empty where the text says it.
    """

    severity: Severity
    text: str
    remedy: str = ""


@dataclass(frozen=True)
class SceneCheck:
    """Result of ``check_scene``.

    Attributes:
        problems: worst first.
        lines: facts about the scene, one sentence each.
        page: the page that shows it.
    """

    problems: tuple[Problem, ...]
    lines: tuple[str, ...]
    page: Path

    @property
    def usable(self) -> bool:
        """Whether there is no error among the problems."""
        return all(problem.severity != "error" for problem in self.problems)


def worst_first(problems: Sequence[Problem]) -> tuple[Problem, ...]:
    """Errors, then warnings, then notes; within each in the given order."""
    order = get_args(Severity)
    return tuple(sorted(problems, key=lambda problem: order.index(problem.severity)))
