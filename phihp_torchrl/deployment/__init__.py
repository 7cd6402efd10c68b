"""Trained agents: acting, saving, loading, exporting, and control in real time."""

from __future__ import annotations

from phihp_torchrl.deployment.agent import Agent
from phihp_torchrl.deployment.c_source import export_c
from phihp_torchrl.deployment.control_report import ControlReport
from phihp_torchrl.deployment.controller import Controller
from phihp_torchrl.deployment.defaults import plain_defaults
from phihp_torchrl.deployment.export import export_aoti, export_onnx, largest_differences
from phihp_torchrl.deployment.export_modules import ActorModule, PlanModule
from phihp_torchrl.deployment.exported import ExportedAgent, load_exported
from phihp_torchrl.deployment.files import load_agent, save_agent
from phihp_torchrl.deployment.formats import TaskSignature
from phihp_torchrl.deployment.kinds import AGENT_KINDS, register_agent
from phihp_torchrl.deployment.observer import VelocityObserver
from phihp_torchrl.deployment.package import PACKAGE_FILE, place_package
from phihp_torchrl.deployment.reading import AgentError
from phihp_torchrl.deployment.realtime import RealTimeReport, run_realtime
from phihp_torchrl.deployment.safety import Safety
from phihp_torchrl.deployment.saved_task import describe_task
from phihp_torchrl.deployment.socket_plant import simulated_plant
from phihp_torchrl.deployment.warm_up import WarmUp

__all__ = [
    "Agent",
    "AgentError",
    "Controller",
    "PlanModule",
    "Safety",
    "VelocityObserver",
    "export_aoti",
    "export_c",
    "export_onnx",
    "load_agent",
    "load_exported",
    "register_agent",
    "run_realtime",
    "save_agent",
]
