"""Controllers by hand in a learned model, to hold a learned controller against."""

from __future__ import annotations

from phihp_torchrl.baselines.catch import Catch
from phihp_torchrl.baselines.controller import Controller
from phihp_torchrl.baselines.energy_shaping import EnergyShaping, PumpConfig
from phihp_torchrl.baselines.ilqr import ILQR, ILQRConfig
from phihp_torchrl.baselines.lqi import LQI
from phihp_torchrl.baselines.lqr import LQR
from phihp_torchrl.baselines.pid import PID
from phihp_torchrl.baselines.registry import (
    BASELINES,
    BaselineKind,
    check_names,
    make_baselines,
    register_baseline,
)
from phihp_torchrl.baselines.settle import Settle
from phihp_torchrl.baselines.take_over import TakeOver

CATCHES = {sort.kind: sort for sort in (Catch, Settle)}
"""The regulators that may take over from an agent's plans, by their kind in files."""

__all__ = ["ILQR", "LQR", "PID", "EnergyShaping", "make_baselines", "register_baseline"]
