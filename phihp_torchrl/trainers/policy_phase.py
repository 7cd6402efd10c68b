"""The policy phase of a run, built from the phase of the model before it."""

from __future__ import annotations

from dataclasses import replace

from phihp_torchrl.trainers.context import Context
from phihp_torchrl.trainers.phases import Phase, register_phase
from phihp_torchrl.trainers.policy import PolicyTrainer
from phihp_torchrl.trainers.policy_config import PolicyConfig
from phihp_torchrl.trainers.policy_search import PolicySearch

LEAST_UPDATES = 2000
"""Updates below which nobody can say that a way to learn fails, or gets on: it is as it is set."""


def build_policy(context: Context) -> Phase:
    """Build the phase; constants are drawn by the covariance that the fit of the model has left.

    Only a phase of at least ``LEAST_UPDATES`` updates is prolonged, or tries other strategies.
    """
    config, model = context.config, context.before["model"]
    settings = context.settings
    if settings.updates < LEAST_UPDATES:
        settings = replace(settings, extension=0.0, strategies="none")
    measured = settings.draw_constants and settings.constants_std is None
    covariance = model.constants_covariance() if measured else None

    def make(settings: PolicyConfig) -> PolicyTrainer:
        return PolicyTrainer(
            context.task,
            model.dynamics,
            settings,
            world=context.world,
            seed=config.seed,
            data_states=model.states(),
            compile=context.compile,
            covariance=covariance,
        )

    if settings.strategies == "none":
        return make(settings)
    return PolicySearch(context.task, settings, make, seed=config.seed)


register_phase("policy", PolicyConfig, build_policy, unit="updates")
