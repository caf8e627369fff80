"""One HTML file that shows a model in colour and in °C, from a disk, with the network off."""

from mrgs.export.page.write import MODALITIES, Modality, write_page

__all__ = ["MODALITIES", "Modality", "write_page"]
