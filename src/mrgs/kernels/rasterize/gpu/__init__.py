"""The rasterizer for NVIDIA GPUs, in Triton: nothing is compiled at install time.

Importing its modules imports Triton; ``mrgs.system.gpu.runs_triton`` decides whether to.
"""
