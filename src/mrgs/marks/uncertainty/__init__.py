"""How far a temperature may be from the truth: by the photos, the model, the camera, and the
settings that the photos were computed with."""

from mrgs.marks.uncertainty.budget import COVERAGE, Uncertainty
from mrgs.marks.uncertainty.meter import UncertaintyMeter

__all__ = ["COVERAGE", "Uncertainty", "UncertaintyMeter"]
