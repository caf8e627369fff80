"""A baked model into files that other programs open."""

from mrgs.export.export import FORMATS, Format, export
from mrgs.export.loss import BakingLoss, baking_loss_db
from mrgs.export.page import write_page

__all__ = ["FORMATS", "BakingLoss", "Format", "baking_loss_db", "export", "write_page"]
