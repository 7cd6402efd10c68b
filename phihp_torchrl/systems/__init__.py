"""Physics: the equations that world and prior share, and the friction that only the world has."""

from __future__ import annotations

from phihp_torchrl.systems.acrobot import Acrobot, ElbowAcrobot
from phihp_torchrl.systems.base import Constants, System, wrap
from phihp_torchrl.systems.cartpole import CartPole
from phihp_torchrl.systems.pendulum import Pendulum

__all__ = ["Acrobot", "CartPole", "Constants", "ElbowAcrobot", "Pendulum", "System", "wrap"]
