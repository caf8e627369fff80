"""The one room that opens files of strangers: scene folders in, a ``mrgs.scene.Scene`` out."""

from mrgs.data.load import load_scene

__all__ = ["load_scene"]
