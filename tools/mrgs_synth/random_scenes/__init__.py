"""Scenes whose layout, materials, light, cameras and temperatures are all drawn from a seed; each
kind is one file."""

from mrgs_synth.random_scenes.kinds import KINDS, RandomKind, drawn_kind, drawn_stage

__all__ = ["KINDS", "RandomKind", "drawn_kind", "drawn_stage"]
