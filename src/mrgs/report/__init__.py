"""One page about a run for a thermographer."""

from mrgs.report.anomalies import Spot, find_spots
from mrgs.report.write import report_run

__all__ = ["Spot", "find_spots", "report_run"]
