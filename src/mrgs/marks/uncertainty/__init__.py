"""How far a temperature may be from the truth: by the photos, the model, the camera, and the
settings that the photos were computed with."""

from mrgs.marks.uncertainty.budget import Uncertainty
from mrgs.marks.uncertainty.meter import UncertaintyMeter

__all__ = ["Uncertainty", "UncertaintyMeter"]
