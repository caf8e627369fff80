"""A solar plant of any size, surveyed by a drone: rays are cast, not traced, so that a thousand
pairs of photos take minutes."""

from mrgs_synth.solar_plant.generate import PlantOptions, synthesize_plant
from mrgs_synth.solar_plant.mornings import synthesize_mornings

__all__ = ["PlantOptions", "synthesize_mornings", "synthesize_plant"]
