"""The transition that PhIHP learns: F^p + F^r, integrated over one control step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from phihp_torchrl.dynamics.prior import PhysicsPrior, WorldPhysics
from phihp_torchrl.dynamics.residual import ResidualMLP
from phihp_torchrl.integrators import Integrator, make_integrator
from phihp_torchrl.tasks import Task


class HybridDynamics(nn.Module):
    r"""The learned transition (paper, section 4.1, equation 2).

    .. math::
        \frac{ds}{dt} = F^p(s, a; \theta_p) + F^r(s, a; \theta_r), \qquad
        s_{t+1} = \mathrm{ODESolve}(s_t, a_t, t, t + \Delta t)

    Either part may be absent: without prior it is the data-driven model, without residual the pure
    prior. :meth:`hybrid`, :meth:`data_driven`, :meth:`pure_prior` and :meth:`oracle` build the four
    models of the paper.

    Args:
        task: gives the system, the time step and the limits on actions and velocities.
        prior: F^p, a module ``(state, action) -> ds/dt``, or ``None``.
        residual: F^r, likewise, or ``None``.
        integrator: solver name or instance.

    Raises:
        ValueError: if both parts are absent, or the integrator is unknown.

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
            raise ValueError("prior, residual: expected at least one of them, got neither.")
        self.task = task
        self.prior = prior
        self.residual = residual
        self.integrator = make_integrator(integrator)

    @classmethod
    def hybrid(
        cls,
        task: Task,
        *,
        constants: Mapping[str, float] | None = None,
        hidden_sizes: Sequence[int] = (16, 16),
        activation: type[nn.Module] = nn.ReLU,
        residual_outputs: str = "velocities",
        integrator: str | Integrator = "semi_implicit_euler",
    ) -> HybridDynamics:
        """The model of the paper: learnable prior and residual.

        Args:
            task: the task.
            constants: first guess of the prior's constants.
            hidden_sizes: widths of the residual's hidden layers.
            activation: class of its activation.
            residual_outputs: ``"velocities"`` corrects accelerations alone (positions follow their
                velocities by definition), ``"all"`` every component of ds/dt, as published.
            integrator: solver name or instance.
        """
        if residual_outputs not in ("velocities", "all"):
            raise ValueError(
                f"residual_outputs: expected 'velocities' or 'all', got {residual_outputs!r}."
            )
        system = task.system
        outputs = system.velocity_indices or None if residual_outputs == "velocities" else None
        return cls(
            task,
            prior=PhysicsPrior(system, constants),
            residual=ResidualMLP(system, hidden_sizes, outputs, activation),
            integrator=integrator,
        )

    @classmethod
    def data_driven(
        cls,
        task: Task,
        *,
        hidden_sizes: Sequence[int] = (16, 16),
        activation: type[nn.Module] = nn.ReLU,
        integrator: str | Integrator = "semi_implicit_euler",
    ) -> HybridDynamics:
        """The same transition without F^p."""
        residual = ResidualMLP(task.system, hidden_sizes, activation=activation)
        return cls(task, prior=None, residual=residual, integrator=integrator)

    @classmethod
    def pure_prior(
        cls,
        task: Task,
        *,
        constants: Mapping[str, float] | None = None,
        integrator: str | Integrator = "semi_implicit_euler",
    ) -> HybridDynamics:
        """The same transition without F^r."""
        prior = PhysicsPrior(task.system, constants)
        return cls(task, prior=prior, residual=None, integrator=integrator)

    @classmethod
    def oracle(cls, task: Task, *, integrator: str | Integrator | None = None) -> HybridDynamics:
        """The world itself, friction and (by default) its integrator included; nothing to learn."""
        prior = WorldPhysics(task.system)
        return cls(task, prior=prior, residual=None, integrator=integrator or task.integrator)

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """The next state: ``[*batch, n], [*batch, m] -> [*batch, n]``; actions are clipped."""
        action = self.task.clip_action(action)
        return self.integrator(
            lambda s: self.derivative(s, action), state, self.task.time_step, self.task.layout
        )

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
        """What the residual explains of the motion: ‖F^r‖ / (‖F^p‖ + ‖F^r‖), scalar in [0, 1]."""
        zero = torch.zeros((), dtype=state.dtype, device=state.device)
        prior = zero if self.prior is None else self.prior(state, action).norm()
        residual = zero if self.residual is None else self.residual(state, action).norm()
        return residual / (prior + residual).clamp_min(torch.finfo(state.dtype).tiny)

    @torch.no_grad()
    def rollout(self, state: Tensor, actions: Tensor) -> Tensor:
        """The states after each of the actions.

        Args:
            state: where to start, ``[*batch, n]``.
            actions: what to do, ``[*batch, time, m]``.

        Returns:
            States after each action, ``[*batch, time, n]``.
        """
        states = []
        for action in actions.unbind(-2):
            state = self(state, action)
            states.append(state)
        return torch.stack(states, -2)
