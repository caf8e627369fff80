"""The rasterizer for NVIDIA GPUs, in Triton, compiled at first use. Its modules import Triton;
``mrgs.system.gpu.runs_triton`` decides whether to."""
