"""The one room that opens files which strangers wrote: scene folders in, a
``mrgs.scene.Scene`` out."""

from mrgs.data.load import load_scene

__all__ = ["load_scene"]
