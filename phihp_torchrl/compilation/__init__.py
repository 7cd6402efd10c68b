"""Compilation of the time-critical functions: one full graph each, with the faster products.

It serves the other folders; nothing here is public.
"""

from phihp_torchrl.compilation.graphs import compile_ahead as compile_ahead
from phihp_torchrl.compilation.graphs import compile_graph as compile_graph

__all__: list[str] = []
