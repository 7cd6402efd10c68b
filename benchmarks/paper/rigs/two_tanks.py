"""Two tanks in a row, of which a log has both levels and the share of the pump."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from phihp_torchrl import Box, System, Task, register_task

GRAVITY = 9.81


class TwoTanks(System):
    """Torricelli: A₁ h₁' = q - a₁ √(2 g h₁), A₂ h₂' = a₁ √(2 g h₁) - a₂ √(2 g h₂)."""

    state_names = ("level_1", "level_2")
    action_names = ("pump",)
    default_constants = {
        "area_1": 0.02,
        "area_2": 0.02,
        "outlet_1": 5e-5,
        "outlet_2": 5e-5,
        "flow": 1e-4,
    }

    def prior(self, state: Tensor, action: Tensor, constants: Mapping[str, Any]) -> Tensor:
        area_1, area_2, outlet_1, outlet_2, flow = constants.values()
        first, second = (2.0 * GRAVITY * state.clamp_min(1e-6)).sqrt().unbind(-1)
        between, out = outlet_1 * first, outlet_2 * second
        inflow = flow * action[..., 0]
        return torch.stack([(inflow - between) / area_1, (between - out) / area_2], -1)


def half_full(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
    """0 where the second tank is half full, and less elsewhere."""
    return -(next_state[..., 1] - 0.3).square()


register_task(
    Task(
        name="two-tanks",
        system=TwoTanks(),
        action_low=(0.0,),
        action_high=(1.0,),
        time_step=1.0,
        max_steps=500,
        reset=Box((0.05, 0.05), (0.15, 0.15)),
        reward=half_full,
    )
)
