"""Scenes made by this project: colour and thermal photos with the exact temperature and depth
behind them.

A scene kind is one file that returns a ``Stage`` (see ``tabletop``) and a line in
``generate.STAGES``; one whose layout is drawn from the seed is a file in ``random_scenes`` and a
line in ``random_scenes.kinds.KINDS``.
"""

from mrgs_synth.generate import SceneKind, synthesize
from mrgs_synth.imager import CameraName

__all__ = ["CameraName", "SceneKind", "synthesize"]
