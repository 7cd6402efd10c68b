"""The policy phase of a run, built from the phase of the model before it."""

from __future__ import annotations

from phihp_torchrl.trainers.context import Context
from phihp_torchrl.trainers.phases import Phase, register_phase
from phihp_torchrl.trainers.policy import PolicyTrainer
from phihp_torchrl.trainers.policy_config import PolicyConfig


def build_policy(context: Context) -> Phase:
    """Build the phase; constants are drawn by the covariance that the fit of the model has left."""
    config, model = context.config, context.before["model"]
    settings = context.settings
    measured = settings.draw_constants and settings.constants_std is None
    return PolicyTrainer(
        context.task,
        model.dynamics,
        settings,
        world=context.world,
        seed=config.seed,
        data_states=model.states(),
        compile=config.compile,
        covariance=model.constants_covariance() if measured else None,
    )


register_phase("policy", PolicyConfig, build_policy, unit="updates")
