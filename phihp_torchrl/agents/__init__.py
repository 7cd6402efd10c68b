"""Actor and critics as modules, and TD3, which trains them (paper, section 4.2)."""

from __future__ import annotations

from phihp_torchrl.agents.analytic_config import AnalyticConfig
from phihp_torchrl.agents.analytic_update import AnalyticUpdate, Draws
from phihp_torchrl.agents.equations import (
    Layers,
    act,
    actor_loss,
    adam_,
    adam_rates,
    critic_loss,
    prepare,
    q_values,
    soft_update_,
    td3_target,
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
from phihp_torchrl.agents.scales import Scales, measure_scales, scaled, visited_states
from phihp_torchrl.agents.td3 import TD3Config, TD3Update, make_td3_loss
from phihp_torchrl.agents.update import ActorCriticUpdate, Networks, learning_rate_scale

__all__ = [
    "Actor",
    "AnalyticConfig",
    "AnalyticUpdate",
    "QNetwork",
    "RefitConfig",
    "TD3Config",
    "TD3Update",
    "TwinQ",
    "act",
    "make_actor",
    "make_qvalue",
    "make_td3_loss",
    "make_twin_qvalue",
]
