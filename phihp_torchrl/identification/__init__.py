"""What recordings say of a system: constants with intervals, the path of a command, errors."""

from __future__ import annotations

from phihp_torchrl.identification.applied import identified_task
from phihp_torchrl.identification.config import IdentifyConfig
from phihp_torchrl.identification.identify import check_system, identify
from phihp_torchrl.identification.page import report_page
from phihp_torchrl.identification.parts import (
    ActuatorEstimate,
    ActuatorTrial,
    Estimate,
    Finding,
    HorizonError,
    Region,
    Residuals,
    Rollout,
    StateError,
)
from phihp_torchrl.identification.paste import ready_to_paste
from phihp_torchrl.identification.result import Identification

__all__ = [
    "Identification",
    "IdentifyConfig",
    "identified_task",
    "identify",
    "report_page",
]
