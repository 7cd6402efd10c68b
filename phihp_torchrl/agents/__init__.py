"""Actor and critics, and how TD3 trains them in imagination."""

from __future__ import annotations

from phihp_torchrl.agents.functional import Batch
from phihp_torchrl.agents.imagination import (
    ChunkNoise,
    Imagination,
    Worlds,
    draw_noise,
    imagine,
    imagined_return,
)
from phihp_torchrl.agents.networks import (
    Actor,
    QNetwork,
    TwinQ,
    copy_actor,
    copy_twin_qvalue,
    make_actor,
    make_qvalue,
    make_twin_qvalue,
)
from phihp_torchrl.agents.refit import CriticRefit, Refit, RefitConfig
from phihp_torchrl.agents.replay import FlatReplay
from phihp_torchrl.agents.stock import StockTD3Update
from phihp_torchrl.agents.td3 import (
    TD3Config,
    TD3Update,
    learning_rate_scale,
    make_td3_loss,
)

__all__ = [
    "Actor",
    "Batch",
    "ChunkNoise",
    "CriticRefit",
    "FlatReplay",
    "Imagination",
    "QNetwork",
    "Refit",
    "RefitConfig",
    "StockTD3Update",
    "TD3Config",
    "TD3Update",
    "TwinQ",
    "Worlds",
    "copy_actor",
    "copy_twin_qvalue",
    "draw_noise",
    "imagine",
    "imagined_return",
    "learning_rate_scale",
    "make_actor",
    "make_qvalue",
    "make_td3_loss",
    "make_twin_qvalue",
]
