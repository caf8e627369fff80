"""The modules of a photovoltaic plant: how warm each is against its neighbours in the row, what that
means by IEC TS 62446-3, and what power is lost.

Thresholds, losses and the normalisation to 1,000 W/m² are stated, with their sources, in
``docs/modules.md``.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy import ndimage

from mrgs.errors import ConfigError, RunError
from mrgs.maps.crs import LOCAL, require_metres
from mrgs.maps.draw import OrthographicMap, draw_map
from mrgs.maps.modules import Modules, find_modules
from mrgs.maps.options import MapOptions
from mrgs.maps.surfaces import grid_from_above, median_distance, survey
from mrgs.marks import open_marks
from mrgs.marks.mark import Mark, places_of
from mrgs.marks.measure import NARROW_HOT
from mrgs.marks.photo_readings import OF_POINT, PhotoReadings, SightingSums
from mrgs.marks.resolution import RESOLVED_PX
from mrgs.marks.tables import DASH, digits, write_features, write_rows
from mrgs.marks.uncertainty import Budget
from mrgs.pictures.files import write_png
from mrgs.pictures.html import PAGE_STYLE, inline_image, write_html
from mrgs.pictures.numbers import number_text
from mrgs.report.overview import Style, TemperatureMap, faces_one_side, has_map
from mrgs.report.texts import Language, Texts
from mrgs.report.write import require_weasyprint, write_pdf
from mrgs.runs.baked import bake
from mrgs.runs.open import Run
from mrgs.scene import THERMAL, Scene, View, WorldFrame
from mrgs.scene.depth_map import visible
from mrgs.survey import SURVEY_FILE, read_survey

SIZES_M, POWERS_W = (0.3, 3.0), (1.0, 2000.0)
"""What modules may have."""

NOMINAL_W_M2, LEAST_W_M2 = 1000.0, 600.0
"""Irradiance to which ΔT is normalised, and from which on that makes sense."""

FINEST, COARSEST = 1 / 40, 1 / 10
"""Pixels of the map, as shares of a module's shorter side."""

PHOTOS, POINTS, NEW = 8, 5000, 0.3
"""Photos that show the same place, in which more are left out; points of the scene by which that is
told; and the share of its points for which a photo must be one of them."""

EDGE_M = 0.06
"""The frame, and what blur mixes with it, do not count."""

CELLS = 6
"""Cells along a module's shorter side; a hot cell is measured over half of its width."""

LEAST_CELL_K, LEAST_PART_K = 4.0, 2.0
"""Smallest ΔT of a hot cell, and of a third or a whole module."""

WATCHED_K, SAFETY_K = 10.0, 20.0
"""ΔT at 1,000 W/m² from which on a hot cell is class 2, and from which on anything is class 3."""

LOSSES = (0.15, 0.3, 0.6)
"""Shares of a module's power that a hot cell costs below, between and above these."""

NEIGHBOURS = 8
"""Places to both sides in the row with which a module is compared."""

HEADINGS = ("Module", "Finding", "Class", "°C", "ΔT", "±", "ΔT at 1,000 W/m²", "Lost, W")


class Reading(NamedTuple):
    """What was measured of M modules, °C and K; NaN where too few photos look.

    Attributes:
        celsius: of the sound part, the median of the coolest third.
        beside: median of the neighbours in the row.
        thirds: how much hotter than that each third is, [M, 3].
        hot: temperature of the hottest cell.
        cells: how much hotter than its third the hottest cell is.
        count: of separate hot cells.
        width: of the hottest one, metres.
        around: uncertainty of the hottest cell and of the module by photos and model, [M, 2].
    """

    celsius: Float64[np.ndarray, " m"]
    beside: Float64[np.ndarray, " m"]
    thirds: Float64[np.ndarray, "m 3"]
    hot: Float64[np.ndarray, " m"]
    cells: Float64[np.ndarray, " m"]
    count: Float64[np.ndarray, " m"]
    width: Float64[np.ndarray, " m"]
    around: Float64[np.ndarray, "m 2"]
