"""The settings of phase 1, and the untrained model that they describe."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import nn

from phihp_torchrl.config import (
    ConfigError,
    check_choice,
    check_count,
    check_fields,
    check_not_negative,
    check_positive,
    check_widths,
)
from phihp_torchrl.dynamics import (
    AUTO,
    RESIDUAL_OUTPUTS,
    SOLVERS,
    FitConfig,
    HybridDynamics,
    perturbed_constants,
)
from phihp_torchrl.integrators import Integrator, check_integrator, has_substeps, integrator_of
from phihp_torchrl.trainers.collect import (
    CollectConfig,
)
from phihp_torchrl.trainers.lateness import CHOICES
from phihp_torchrl.worlds import (
    SimulatedWorld,
    World,
)

_ACTIVATIONS: dict[str, type[nn.Module]] = {"relu": nn.ReLU, "tanh": nn.Tanh, "silu": nn.SiLU}


_MOST_MEMBERS = 1024


@dataclass(frozen=True)
class ModelConfig:
    """Settings of phase 1, which learns the model (paper, section 4.1 and appendix C).

    Args:
        real_steps: total number of real transitions; 0 is allowed for an oracle. A recorded world
            gives all that it has.
        steps_per_iteration: real transitions between two fits, T; null for a tenth of all of them,
            but at least 50.
        kind: hybrid (prior + residual), data_driven (no prior), prior (no residual) or oracle (the
            simulated world itself).
        constants_error: in a simulated world, relative error of the first guesses of the prior's
            constants, with signs drawn by the seed; in other worlds the system's guesses are used.
        hidden_sizes: widths of the residual's hidden layers.
        activation: activation of the residual: relu, tanh or silu.
        residual_outputs: components that the residual corrects, velocities (accelerations only) or
            all (every component of ds/dt).
        ensemble: number of residual networks; with more than one, each imagined life has one of
            them and plans use their mean. The time of a fit is proportional to it.
        integrator: integrator of the model, semi_implicit_euler, rk4 or dopri5; or auto, for the
            cheapest one with fixed steps that predicts held-out transitions about as well as any.
        substeps: solver steps in a control step; 1 for dopri5 and auto, which choose their steps.
        actuator: auto to choose dead time and lag of the commands by held-out error, where the task
            has no actuator and previous commands explain the model's errors; none to choose
            nothing.
        lambda_0: initial λ of the published loss, which divides the weight of ‖F^r‖.
        tau_ph: growth of λ with the prediction error.
        warm_start: whether a fit starts from the previous one. The fits between the first and the
            last then keep the final λ, and take at most refit_steps.
        refit_steps: largest number of steps of such a fit; the first and the last fit take all.
        restarts: fits from other first weights of the residual after the last one, of which the
            best by held-out error is kept; only by least squares, and where the held-out error is
            over twice the error on the fitted transitions.
        fit: how the model is fitted.
        collect: how real data are collected.

    Raises:
        ConfigError: for a value out of range; the message names the field.

    Examples:
        >>> config = ModelConfig(real_steps=1000, steps_per_iteration=400)
        >>> config.iterations  # 400, 400 and 200 steps
        3
    """

    real_steps: int = 5000
    steps_per_iteration: int | None = None
    kind: str = "hybrid"
    constants_error: float = 0.3
    hidden_sizes: tuple[int, ...] = (16, 16)
    activation: str = "tanh"
    residual_outputs: str = "velocities"
    ensemble: int = 1
    integrator: str = AUTO
    substeps: int = 1
    actuator: str = AUTO
    lambda_0: float = 1e3
    tau_ph: float = 1e3
    warm_start: bool = True
    refit_steps: int = 15
    restarts: int = 2
    fit: FitConfig = field(default_factory=FitConfig)
    collect: CollectConfig = field(default_factory=CollectConfig)

    def __post_init__(self) -> None:
        check_fields(self)
        check_choice(self, "kind", ("hybrid", "data_driven", "prior", "oracle"))
        check_count(self, "real_steps", least=0 if self.kind == "oracle" else 1)
        if self.steps_per_iteration is not None:
            check_count(self, "steps_per_iteration")
        check_count(self, "refit_steps", "ensemble")
        check_count(self, "restarts", least=0)
        if self.ensemble > _MOST_MEMBERS:
            raise ConfigError("ensemble", f"expected at most {_MOST_MEMBERS}, got {self.ensemble}.")
        if self.ensemble > 1 and self.kind not in ("hybrid", "data_driven"):
            raise ConfigError(
                "ensemble",
                f"expected 1 for a model of kind {self.kind!r}, which has no residual, "
                f"got {self.ensemble}.",
            )
        check_choice(self, "residual_outputs", RESIDUAL_OUTPUTS)
        check_choice(self, "activation", _ACTIVATIONS)
        check_choice(self, "actuator", CHOICES)
        if self.integrator != AUTO:
            check_integrator(self)
        elif self.substeps != 1:
            raise ConfigError("substeps", f"expected 1 for {AUTO}, got {self.substeps}.")
        check_widths(self, "hidden_sizes")
        check_positive(self, "lambda_0")
        check_not_negative(self, "tau_ph")
        if not 0 <= self.constants_error < 1:
            raise ConfigError(
                "constants_error",
                f"expected a relative error in [0, 1), got {self.constants_error}.",
            )
        if self.kind != "oracle" and self.fit.method != "adam" and not self.has_fixed_steps:
            raise ConfigError(
                "fit.method",
                f"expected 'adam' for a model that is integrated by {self.integrator}, which "
                f"chooses its own steps, got {self.fit.method!r}.",
            )

    @property
    def has_fixed_steps(self) -> bool:
        """Whether the model's integrator takes steps of fixed length, as least squares need."""
        return self.integrator == AUTO or has_substeps(self.integrator)

    @property
    def period(self) -> int:
        """Real transitions between two fits, T."""
        return self.steps_per_iteration or max(50, -(-self.real_steps // 10))

    @property
    def iterations(self) -> int:
        """Number of fits."""
        return -(-self.real_steps // self.period)

    @property
    def refit(self) -> FitConfig:
        """Settings of a fit that goes on from the one before: fewer steps, from the last λ on."""
        steps = min(self.fit.steps, self.refit_steps)
        return replace(self.fit, steps=steps, initial_lambda=self.fit.final_lambda)


def make_dynamics(
    world: World, config: ModelConfig, generator: torch.Generator | None = None
) -> HybridDynamics:
    """Build the untrained model that ``config`` describes, for the task of ``world``.

    Args:
        world: the world. If it is simulated, its equations are the oracle's model, and its true
            constants are perturbed for the first guesses.
        config: settings of phase 1.
        generator: source of the signs of the errors of the first guesses. The initial weights of
            networks come from torch's global generator.

    Raises:
        ConfigError: for an oracle in a world that is not simulated.
    """
    task = world.task
    if config.kind == "oracle":
        if not isinstance(world, SimulatedWorld):
            raise ConfigError(
                "model.kind", f"expected another than 'oracle': {world} has no truth to plan with."
            )
        return world.oracle()
    integrator = first_integrator(config)
    activation, sizes = _ACTIVATIONS[config.activation], config.hidden_sizes
    if config.kind == "data_driven":
        return HybridDynamics.data_driven(
            task,
            hidden_sizes=sizes,
            activation=activation,
            integrator=integrator,
            ensemble=config.ensemble,
        )
    guess = _first_guess(world, config.constants_error, generator)
    if config.kind == "prior":
        return HybridDynamics.pure_prior(task, constants=guess, integrator=integrator)
    return HybridDynamics.hybrid(
        task,
        constants=guess,
        hidden_sizes=sizes,
        activation=activation,
        residual_outputs=config.residual_outputs,
        integrator=integrator,
        ensemble=config.ensemble,
    )


def first_integrator(config: ModelConfig) -> Integrator:
    """The integrator of an untrained model; of ``auto`` the cheapest, which is tried first."""
    return SOLVERS[0] if config.integrator == AUTO else integrator_of(config)


def _first_guess(world: World, error: float, generator: torch.Generator | None) -> dict[str, float]:
    """First guesses: those of the system, or perturbed true constants in a simulated world."""
    ranges = world.task.system.ranges
    if world.truth is None:
        return {name: c.guess for name, c in ranges.items()}
    wrong = perturbed_constants(world.truth.constants, error, generator)
    # Fixed and bounded constants keep the guess of the system.
    return {n: c.guess if c.fixed or c.bounded else wrong[n] for n, c in ranges.items()}
