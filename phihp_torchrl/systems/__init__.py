"""What is known of a system: its equations F^p and first guesses of their constants."""

from __future__ import annotations

from phihp_torchrl.systems import terms
from phihp_torchrl.systems.acrobot import Acrobot, ElbowAcrobot, solve_inertia
from phihp_torchrl.systems.base import Constant, Constants, System, override, wrap
from phihp_torchrl.systems.cart_double_pendulum import CartDoublePendulum
from phihp_torchrl.systems.cartpole import CartPole, accelerations
from phihp_torchrl.systems.lagrangian import LagrangianSystem
from phihp_torchrl.systems.names import check_names
from phihp_torchrl.systems.pendulum import Pendulum
from phihp_torchrl.systems.two_link_arm import TwoLinkArm

__all__ = [
    "Acrobot",
    "CartDoublePendulum",
    "CartPole",
    "Constant",
    "ElbowAcrobot",
    "LagrangianSystem",
    "Pendulum",
    "System",
    "TwoLinkArm",
    "terms",
    "wrap",
]
