"""One page about a run for a thermographer."""

from mrgs.report.spots import Spot, find_spots
from mrgs.report.write import write_report

__all__ = ["Spot", "find_spots", "write_report"]
