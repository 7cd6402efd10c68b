"""Environments: the real worlds for gymnasium, and imagination in a learned model."""

from __future__ import annotations

from phihp_torchrl.envs.registration import register_envs
from phihp_torchrl.envs.worlds import TaskEnv

__all__ = ["TaskEnv", "register_envs"]

register_envs()
