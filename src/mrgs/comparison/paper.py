"""The figures that the paper published, as rows beside those that were measured."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from typing import Any

from mrgs.comparison.results import Cell, over_scenes
from mrgs.evaluation.figures import Missing

METHODS = ("ThermoNeRF", "3DGS_RGB-T", "MrGS")
"""Rows of the paper's tables of thermal and RGB images."""


@cache
def published() -> dict[str, Any]:
    """``paper.json``: of each table, by the paper's name of the scene, then by the row, the
    figures.

    ``scenes`` maps ThermoScenes' folder names to the paper's names. The ablation's rows bear the
    method names of this program, the rows of ``neighbours`` the paper's n.
    """
    content: dict[str, Any] = json.loads(
        files("mrgs.comparison").joinpath("paper.json").read_text(encoding="utf-8")
    )
    return content


def scene_title(scene: str) -> str | None:
    """The paper's name of a ThermoScenes scene, by its folder's name; None for other scenes."""
    title: str | None = published()["scenes"].get(scene)
    return title


def rows_of(table: str, scene: str) -> dict[str, dict[str, float | None]]:
    """The paper's rows of a table for a scene; empty where it has none."""
    title = scene_title(scene)
    return {} if title is None else published().get(table, {}).get(title, {})


def cell(table: str, scene: str, row: str, figure: str) -> Cell:
    """One published figure, by its name in ``results.figure_keys``."""
    figures = rows_of(table, scene).get(row)
    if figures is None:
        return Cell(None, note="the paper has no figures of this scene")
    value = figures.get(figure.rpartition(".")[2])
    return Cell(None, note="the paper does not say") if value is None else Cell(float(value))


def mean_cell(table: str, scenes: Sequence[str], row: str, figure: str) -> Cell:
    """The mean of a published figure over scenes; the paper prints none."""
    cells = [cell(table, scene, row, figure) for scene in scenes]
    figures = [[Missing(found.note or "") if found.mean is None else found.mean] for found in cells]
    return over_scenes(figures, scenes)
