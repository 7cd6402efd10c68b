"""Trained agents, whole: ready to act, to save and to load."""

from __future__ import annotations

from phihp_torchrl.deployment.agent import Agent
from phihp_torchrl.deployment.export import (
    PlanModule,
    export_aoti,
    export_onnx,
    largest_differences,
)
from phihp_torchrl.deployment.files import load_agent, save_agent
from phihp_torchrl.deployment.reading import AgentError
from phihp_torchrl.deployment.realtime import RealTimeReport, run_realtime
from phihp_torchrl.deployment.tdmpc import TDMPCAgent

__all__ = [
    "Agent",
    "AgentError",
    "PlanModule",
    "RealTimeReport",
    "TDMPCAgent",
    "export_aoti",
    "export_onnx",
    "largest_differences",
    "load_agent",
    "run_realtime",
    "save_agent",
]
