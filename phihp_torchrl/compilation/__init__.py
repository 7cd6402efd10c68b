"""Compilation of the time-critical functions: one full graph each, with the faster products.

It serves the other folders; nothing here is public.
"""

from phihp_torchrl.compilation.graphs import compile_ahead as compile_ahead
from phihp_torchrl.compilation.graphs import compile_graph as compile_graph
from phihp_torchrl.compilation.other_process import OtherProcess as OtherProcess

__all__: list[str] = []
