"""The transition that PhIHP learns: F^p + F^r, integrated over one control step (equation 2)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from phihp_torchrl.config import ConfigError, Registry
from phihp_torchrl.dynamics.compiled_step import CompiledStep
from phihp_torchrl.dynamics.ensemble import EnsembleResidual
from phihp_torchrl.dynamics.prior import PhysicsPrior
from phihp_torchrl.dynamics.residual import ResidualMLP
from phihp_torchrl.integrators import (
    Integrator,
    integrator_mapping,
    make_integrator,
    read_integrator,
)
from phihp_torchrl.systems import System
from phihp_torchrl.tasks import Task

RESIDUAL_OUTPUTS = ("velocities", "all")
"""The components of ds/dt that a residual may correct: those of velocities, or all."""

PRIORS: Registry[Any] = Registry("prior")
"""Modules that can be F^p, by the ``kind`` in their ``config``."""

PRIORS.register(PhysicsPrior.kind, PhysicsPrior)


class HybridDynamics(nn.Module):
    r"""The learned transition (paper, section 4.1, equation 2).

    .. math::
        \frac{ds}{dt} = F^p(s, a; \theta_p) + F^r(s, a; \theta_r), \qquad
        s_{t+1} = \mathrm{ODESolve}(s_t, a_t, t, t + \Delta t)

    Either part may be absent: without the prior this is the data-driven model, without the residual
    the pure prior. :meth:`hybrid`, :meth:`data_driven` and :meth:`pure_prior` build the models of
    the paper. Its oracle is the simulated world itself
    (:meth:`~phihp_torchrl.worlds.SimulatedWorld.oracle`).

    Args:
        task: the task, which has the system, the time step and the limits of actions and
            velocities.
        prior: F^p, a module ``(state, action) -> ds/dt``, or ``None``.
        residual: F^r, a module ``(state, action) -> ds/dt``, or ``None``.
        integrator: name of an integrator, or an instance.

    Raises:
        ConfigError: if both parts are absent, or the integrator is unknown.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> dynamics = HybridDynamics.hybrid(get_task("cartpole"))
        >>> dynamics(torch.zeros(5, 4), torch.zeros(5, 1)).shape
        torch.Size([5, 4])
    """

    def __init__(
        self,
        task: Task,
        *,
        prior: nn.Module | None,
        residual: nn.Module | None,
        integrator: str | Integrator = "semi_implicit_euler",
    ) -> None:
        super().__init__()
        if prior is None and residual is None:
            raise ConfigError("prior, residual", "expected at least one of them, got neither.")
        self.task = task
        self.prior = prior
        self.residual = residual
        self.integrator = make_integrator(integrator)
        impulse = getattr(prior, "impulse", None)  # how a stop of one position acts on the others
        self.layout = task.layout if impulse is None else task.layout.coupled(impulse)
        self.compiled_step: CompiledStep | None = None
        """:meth:`step` as one graph for plans and imagination, after :meth:`compile_step`."""

    def __getstate__(self) -> dict[str, Any]:
        # The graph is that of this model's weights, and not a copy's.
        return {**super().__getstate__(), "compiled_step": None}

    @classmethod
    def hybrid(
        cls,
        task: Task,
        *,
        constants: Mapping[str, float] | None = None,
        hidden_sizes: Sequence[int] = (16, 16),
        activation: type[nn.Module] = nn.Tanh,
        residual_outputs: str = "velocities",
        integrator: str | Integrator = "semi_implicit_euler",
        ensemble: int = 1,
    ) -> HybridDynamics:
        """Build the model of the paper: a prior with learned constants, and a residual network.

        Args:
            task: the task.
            constants: first guesses of the prior's constants, by name.
            hidden_sizes: widths of the residual's hidden layers.
            activation: class of the residual's activation.
            residual_outputs: ``"velocities"`` corrects the accelerations only (the derivative of a
                position is its velocity by definition), ``"all"`` every component of ds/dt, as
                published.
            integrator: name of an integrator, or an instance.
            ensemble: number of residual networks (:class:`EnsembleResidual`); 1 for a single one.

        Raises:
            ConfigError: for an unknown ``residual_outputs``, integrator or constant, and for an
                ensemble of less than one.
        """
        if residual_outputs not in RESIDUAL_OUTPUTS:
            raise ConfigError(
                "residual_outputs",
                f"expected one of {list(RESIDUAL_OUTPUTS)}, got {residual_outputs!r}.",
            )
        system = task.system
        outputs = system.velocity_indices or None if residual_outputs == "velocities" else None
        return cls(
            task,
            prior=PhysicsPrior(system, constants),
            residual=_residual(system, hidden_sizes, outputs, activation, ensemble),
            integrator=integrator,
        )

    @classmethod
    def data_driven(
        cls,
        task: Task,
        *,
        hidden_sizes: Sequence[int] = (16, 16),
        activation: type[nn.Module] = nn.Tanh,
        integrator: str | Integrator = "semi_implicit_euler",
        ensemble: int = 1,
    ) -> HybridDynamics:
        """Build the transition without F^p, the paper's data-driven model."""
        residual = _residual(task.system, hidden_sizes, None, activation, ensemble)
        return cls(task, prior=None, residual=residual, integrator=integrator)

    @classmethod
    def pure_prior(
        cls,
        task: Task,
        *,
        constants: Mapping[str, float] | None = None,
        integrator: str | Integrator = "semi_implicit_euler",
    ) -> HybridDynamics:
        """Build the transition without F^r, from the prior alone."""
        prior = PhysicsPrior(task.system, constants)
        return cls(task, prior=prior, residual=None, integrator=integrator)

    @property
    def config(self) -> dict[str, Any]:
        """Plain values from which :meth:`from_config` builds it again, without the weights.

        Raises:
            ConfigError: for a part without an attribute ``config`` of that sort.
        """
        parts = {"prior": self.prior, "residual": self.residual}
        return {
            **{
                name: None if part is None else _config_of(name, part)
                for name, part in parts.items()
            },
            "integrator": integrator_mapping(self.integrator),
        }

    @classmethod
    def from_config(cls, task: Task, config: Mapping[str, Any]) -> HybridDynamics:
        """Build untrained dynamics from :attr:`config`.

        Raises:
            ConfigError: for an unknown kind of prior, activation or integrator.
        """
        prior, residual = config["prior"], config["residual"]
        if prior is not None:
            prior = PRIORS.find(prior["kind"]).from_config(task.system, prior)
        if residual is not None:
            kind = EnsembleResidual if "members" in residual else ResidualMLP
            residual = kind.from_config(task.system, residual)
        solver = read_integrator(config["integrator"])
        return cls(task, prior=prior, residual=residual, integrator=solver)

    def forward(self, state: Tensor, action: Tensor, time_step: Tensor | None = None) -> Tensor:
        """The next state: ``[*batch, n], [*batch, m] -> [*batch, n]``; the action is clipped."""
        count = self.task.action_dim
        clipped = self.task.clip_action(action[..., :count])
        if self.task.system.input_names:
            clipped = torch.cat([clipped, action[..., count:]], -1)
        return self.step(state, clipped, time_step)

    def step(self, state: Tensor, action: Tensor, time_step: Tensor | None = None) -> Tensor:
        """The next state for what acts on the system, as :meth:`Task.transition` needs it.

        Args:
            state: states of the system ``[*batch, n]``.
            action: what acts on it, ``[*batch, m]``.
            time_step: seconds for which each action is held, ``[*batch, 1]``. Defaults to the time
                step of the task.
        """
        seconds = self.task.time_step if time_step is None else time_step
        return self.integrator(lambda s: self.derivative(s, action), state, seconds, self.layout)

    def compile_step(self) -> None:
        """Let plans and imagination that are not compiled themselves use a compiled :meth:`step`.

        The first of them compiles it, which takes about 0.06 s for each of its operations
        (``benchmarks/speed/compiling.py``). Its results are those of :meth:`step` up to rounding.
        It serves calls without gradients; a copy of the model does not have it. Nothing happens
        with an adaptive integrator, which does not compile.
        """
        if self.integrator.compiles and self.compiled_step is None:
            self.compiled_step = CompiledStep(lambda state, action: self.step(state, action))

    def derivative(self, state: Tensor, action: Tensor) -> Tensor:
        """ds/dt = F^p + F^r, ``[*batch, n]``."""
        if self.prior is None:
            assert self.residual is not None  # __init__ asks for at least one
            return self.residual(state, action)
        if self.residual is None:
            return self.prior(state, action)
        return self.prior(state, action) + self.residual(state, action)

    @torch.no_grad()
    def residual_share(self, state: Tensor, action: Tensor) -> Tensor:
        """Share of the residual in the motion, ‖F^r‖ / (‖F^p‖ + ‖F^r‖), a scalar in [0, 1]."""
        zero = torch.zeros((), dtype=state.dtype, device=state.device)
        prior = zero if self.prior is None else self.prior(state, action).norm()
        residual = zero if self.residual is None else self.residual(state, action).norm()
        return residual / (prior + residual).clamp_min(torch.finfo(state.dtype).tiny)

    @torch.no_grad()
    def rollout(self, state: Tensor, actions: Tensor, time_step: Tensor | None = None) -> Tensor:
        """Predict the states of a sequence of actions.

        Args:
            state: first state, ``[*batch, n]``.
            actions: what acts on the system in each step, ``[*batch, time, m]``.
            time_step: seconds for which each is held, ``[*batch, time, 1]``. Defaults to the time
                step of the task.

        Returns:
            States after each action, ``[*batch, time, n]``.
        """
        states = []
        for k, action in enumerate(actions.unbind(-2)):
            state = self.step(state, action, None if time_step is None else time_step[..., k, :])
            states.append(state)
        return torch.stack(states, -2)


def _residual(
    system: System,
    hidden_sizes: Sequence[int],
    outputs: Sequence[int] | None,
    activation: type[nn.Module],
    ensemble: int,
) -> ResidualMLP:
    if ensemble == 1:
        return ResidualMLP(system, hidden_sizes, outputs, activation)
    return EnsembleResidual(system, ensemble, hidden_sizes, outputs, activation)


def _config_of(name: str, part: nn.Module) -> dict[str, Any]:
    config = getattr(part, "config", None)
    if not isinstance(config, dict):
        raise ConfigError(
            name,
            "expected a part that says how it is built (`config`, `from_config`), "
            f"got {type(part).__name__}.",
        )
    return config
