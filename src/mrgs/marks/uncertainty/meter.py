"""The uncertainty of the temperatures of one run, by all that is known of it."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float, Float32

from mrgs.marks.emissivity import SurfaceSettings
from mrgs.marks.regions import Regions
from mrgs.marks.surface import SurfaceRenderer
from mrgs.marks.uncertainty.budget import Budget, Uncertainty
from mrgs.marks.uncertainty.witnesses import PhotoWitnesses
from mrgs.runs.open import Run
from mrgs.scene import CameraResponse, Scene, TemperatureRange
from mrgs.survey import SURVEY_FILE, Survey, read_survey


class UncertaintyMeter:
    """Says how far temperatures may be from the truth, in 95 of 100 cases.

    Args:
        witnesses: the thermal photos.
        budget: of what does not depend on the place; None without known °C.

    Attributes:
        notes: what was assumed, one sentence each.
    """

    def __init__(self, witnesses: PhotoWitnesses, budget: Budget | None) -> None:
        self.notes = () if budget is None else budget.notes
        self._witnesses = witnesses
        self._budget = budget

    @classmethod
    def of_run(cls, run: Run, scene: Scene) -> UncertaintyMeter:
        """Of a run, with what the survey in its folder states.

        Raises:
            ConfigError: the survey has a value that cannot be.
            RunError: the survey cannot be read.
        """
        survey = read_survey(run.folder.path / SURVEY_FILE)
        return cls.of(run.render, run.camera_response, scene, run.temperature, survey)

    @classmethod
    def of(
        cls,
        render: SurfaceRenderer,
        respond: CameraResponse,
        scene: Scene,
        temperature: TemperatureRange | None,
        survey: Survey,
    ) -> UncertaintyMeter:
        """Of a model that is rendered in any way.

        Args:
            render: renders it with the depth of its surfaces.
            respond: what the scene's cameras make of a rendering.
            scene: with the photos.
            temperature: the scale of the thermal values; None without known °C.
            survey: states uncertainties of camera and settings.
        """
        witnesses = PhotoWitnesses(render, respond, scene.train, temperature)
        return cls(witnesses, None if temperature is None else Budget.of(scene, survey))

    def of_mark(
        self,
        points: Float32[np.ndarray, "n 3"],
        value: float,
        surface: SurfaceSettings | None = None,
    ) -> Uncertainty:
        """Of the mean of a mark.

        Args:
            points: on its surface, world coordinates.
            value: the mean as the photos have it, °C or normalised.
            surface: emissivity and reflected temperature there; those of the photos if None.

        Raises:
            SceneError: a photo cannot be read.
        """
        parts = Uncertainty(*(float(part[0]) for part in self._witnesses.of_mark(points, value)))
        if self._budget is None or math.isnan(parts.photos):
            return parts
        return self._budget.with_settings(parts, value, surface)

    def of_points(
        self,
        points: Float32[np.ndarray, "n 3"],
        values: Float32[np.ndarray, " n"],
        regions: Regions | None = None,
    ) -> Float32[np.ndarray, " n"]:
        """Of temperatures at points on surfaces, all parts together; NaN where no photo looked,
        [N].

        Args:
            points: world coordinates.
            values: what the cameras of the photos see there, not corrected, °C or normalised.
            regions: surfaces whose temperatures are corrected for settings of their own.

        Raises:
            SceneError: a photo cannot be read.
        """
        return self.together(self.of_photos(points), points, values, regions).astype(np.float32)

    def of_photos(self, points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, " n"]:
        """The parts of photos and model alone; see ``of_points``."""
        return self._witnesses.of_points(points).total.astype(np.float32)

    def together(
        self,
        of_photos: Float[np.ndarray, "*shape"],
        points: Float[np.ndarray, "*shape 3"],
        values: Float[np.ndarray, "*shape"],
        regions: Regions | None = None,
        eye: Float[np.ndarray, "3"] | None = None,
    ) -> Float[np.ndarray, "*shape"]:
        """What ``of_photos`` gave, with the parts of camera and settings; see ``of_points``.

        Args:
            of_photos: of the points.
            points: world coordinates.
            values: not corrected.
            regions: surfaces with settings of their own.
            eye: that sees the points, if they are pixels of an image.
        """
        if self._budget is None:
            return of_photos
        celsius = values.astype(np.float64)
        total = self._budget.together(of_photos, celsius)
        for settings, held in () if regions is None else regions.parts(points, eye):
            total[held] = self._budget.together(of_photos[held], celsius[held], settings)
        return total
