"""What is known of a system: its equations F^p and first guesses of their constants."""

from __future__ import annotations

from phihp_torchrl.systems.acrobot import Acrobot, ElbowAcrobot, solve_inertia
from phihp_torchrl.systems.base import Constant, Constants, System, override, wrap
from phihp_torchrl.systems.cartpole import CartPole, accelerations
from phihp_torchrl.systems.pendulum import Pendulum

__all__ = ["Acrobot", "CartPole", "Constant", "ElbowAcrobot", "Pendulum", "System", "wrap"]
