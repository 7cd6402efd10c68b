"""The smallest method: it adds up random numbers, so that a whole run takes milliseconds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from phihp_torchrl.config import Method, register_method
from phihp_torchrl.trainers import RunConfig, register_phase

from .run_parts import Crash

TASK = "brief-pendulum"


@dataclass(frozen=True)
class TallyConfig:
    """How often to add, and what.

    Args:
        units: units of work.
        scale: factor on what is added; a text for the sake of links and the like.
        spoil: the unit whose weight becomes NaN; -1 for none.
    """

    units: int = 3
    scale: float = 1.0
    spoil: int = -1


class Tally:
    """Adds up random numbers."""

    fail_at = -1
    """The unit before which it crashes, in all of them."""

    def __init__(self, config: TallyConfig) -> None:
        self.config = config
        self.weight = torch.zeros(16)
        self.count = 0

    @property
    def done(self) -> bool:
        return self.count >= self.config.units

    @property
    def progress(self) -> tuple[int, int]:
        return self.count, self.config.units

    def trained(self) -> dict[str, Tensor]:
        return {"weight": self.weight}

    def advance(self) -> dict[str, float]:
        if self.count == self.fail_at:
            raise Crash
        self.weight += self.config.scale * torch.rand(16)
        if self.count == self.config.spoil:
            self.weight[3] = torch.nan
        self.count += 1
        return {"tally/sum": self.weight.sum().item()}

    def state_dict(self) -> dict[str, Any]:
        return {"weight": self.weight, "count": self.count}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.weight.copy_(state["weight"])
        self.count = state["count"]


def register_tally() -> None:
    """Register phases and method; the fixture ``tally`` does it for a test."""
    names = ("tally-one", "tally-two")
    for name in names:
        register_phase(name, TallyConfig, lambda context: Tally(context.settings), replace=True)
    register_method("tally", Method("Tally", "adds up", names, acting="actor"), replace=True)


def tally_config(first: TallyConfig | None = None, **options: Any) -> RunConfig:
    """A run of two phases of three units each."""
    sections = {"tally-one": first or TallyConfig(), "tally-two": TallyConfig()}
    return RunConfig(
        TASK,
        method="tally",
        checkpoint_interval=0.0,
        progress=False,
        compile=False,
        sections=sections,
        **options,
    )


def final_states(path: Path) -> list[bytes]:
    """The tensors that a finished run ended with, and the table without its times."""
    return [
        next((path / "phases" / name).rglob("tensors.safetensors")).read_bytes()
        for name in ("tally-one", "tally-two")
    ]
