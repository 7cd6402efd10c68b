"""Imagination: start states, rollouts of a policy in a model, and the model as an environment."""

from __future__ import annotations

from phihp_torchrl.imagination.generator_state import Packed, pack_generator, unpack_generator
from phihp_torchrl.imagination.given_starts import GivenStarts
from phihp_torchrl.imagination.latent_model_env import LatentModelEnv
from phihp_torchrl.imagination.rewarding_states import rewarding_states
from phihp_torchrl.imagination.rollouts import (
    ChunkNoise,
    Policy,
    Returns,
    Rollouts,
    Worlds,
    draw_noise,
    step_worlds,
    sum_rewards,
    sum_rewards_at_once,
)
from phihp_torchrl.imagination.signal_stream import SignalStream
from phihp_torchrl.imagination.start_states import (
    BoxStates,
    DataStates,
    MixtureStates,
    StartConfig,
    StartStates,
    TaskStates,
    make_start_states,
)
from phihp_torchrl.imagination.transitions import Batch, Transit, finite_transition
from phihp_torchrl.imagination.world_model_env import WorldModelEnv

__all__ = [
    "Batch",
    "BoxStates",
    "DataStates",
    "MixtureStates",
    "Rollouts",
    "SignalStream",
    "StartConfig",
    "StartStates",
    "TaskStates",
    "WorldModelEnv",
    "make_start_states",
]
