"""Readers of files that strangers may have made: a scene folder in, a ``mrgs.scene.Scene`` out."""

from mrgs.data.load import load_scene

__all__ = ["load_scene"]
