"""What a training step costs, stage by stage: ``make bench``, or ``python -m benchmarks
--quick``."""
