"""Everything from photos to results in one call, in stages that are kept; imported on first use."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mrgs.system.lazy import lazy_imports

if TYPE_CHECKING:
    from mrgs.pipeline.plan import Monitor as Monitor
    from mrgs.pipeline.plan import PipelinePlan as PipelinePlan
    from mrgs.pipeline.plan import PlannedStage as PlannedStage
    from mrgs.pipeline.run import PipelineResults as PipelineResults
    from mrgs.pipeline.run import run_pipeline as run_pipeline

__getattr__, __dir__, __all__ = lazy_imports(__name__)
