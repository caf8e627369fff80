"""Scores and pictures of a trained model."""

from mrgs.evaluation.evaluate import Metrics, ViewMetrics, evaluate
from mrgs.evaluation.report import RunFacts, write_report
from mrgs.evaluation.score_run import evaluate_run, render_run

__all__ = [
    "Metrics",
    "RunFacts",
    "ViewMetrics",
    "evaluate",
    "evaluate_run",
    "render_run",
    "write_report",
]
