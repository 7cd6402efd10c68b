"""The loss of the hybrid model: L_pred + (1/lambda) |F^r| (paper, section 4.1, equation 3)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import LossModule

from phihp_torchrl.config import ConfigError, check_not_negative, check_positive
from phihp_torchrl.dynamics.hybrid import HybridDynamics
from phihp_torchrl.dynamics.residual import spread


class DynamicsLoss(LossModule):
    r"""The loss of the hybrid model (paper, section 4.1, equation 3).

    .. math::
        L_\lambda(\theta) = L_{pred} + \frac{1}{\lambda}\lVert F^r\rVert_2, \qquad
        L_{pred} = \mathrm{mean}\,\lVert s' - \hat s'\rVert^2, \qquad
        \lambda \leftarrow \lambda + \tau_{ph} L_{pred}

    Angles are compared on the circle. :math:`\lVert F^r\rVert_2` is the mean over the batch of each
    transition's norm, so that it does not grow with the batch. After :meth:`set_scales`, errors and
    residual are measured in units of the data's one-step changes, component by component, so that
    components that change slowly count as much as others; without it they are in raw units, as
    published.

    Args:
        dynamics: the model to fit.
        lambda_0: initial value of :math:`\lambda`.
        tau_ph: growth of :math:`\lambda` with the prediction error.

    Raises:
        ConfigError: if ``lambda_0`` is not positive or ``tau_ph`` is negative.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> task = get_task("pendulum")
        >>> loss = DynamicsLoss(HybridDynamics.hybrid(task), lambda_0=1e3, tau_ph=1e3)
        >>> observation = task.observe(task.reset.sample([8]))
        >>> data = TensorDict(
        ...     observation=observation,
        ...     action=torch.zeros(8, 1),
        ...     next=TensorDict(observation=observation, batch_size=[8]),
        ...     batch_size=[8],
        ... )
        >>> sorted(loss(data).keys())
        ['loss_prediction', 'loss_residual', 'residual_norm']
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that can be set with ``set_keys``; observations are also read under ``"next"``."""

        observation: NestedKey = "observation"
        action: NestedKey = "action"
        time_step: NestedKey = "time_step"  # optional; the task's time step where it is absent

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_prediction", "loss_residual", "residual_norm"]

    dynamics: HybridDynamics
    lambda_: Tensor
    error_scale: Tensor
    residual_scale: Tensor

    def __init__(
        self, dynamics: HybridDynamics, *, lambda_0: float = 1e3, tau_ph: float = 1e3
    ) -> None:
        super().__init__()
        self.dynamics = dynamics
        self.lambda_0, self.tau_ph = lambda_0, tau_ph
        check_positive(self, "lambda_0")
        check_not_negative(self, "tau_ph")
        device = next((p.device for p in dynamics.parameters()), None)
        ones = torch.ones(dynamics.task.system.state_dim, device=device)
        self.register_buffer("lambda_", torch.tensor(float(lambda_0), device=device))
        self.register_buffer("error_scale", ones)
        self.register_buffer("residual_scale", ones.clone())

    @property
    def in_keys(self) -> list[NestedKey]:
        keys = self.tensor_keys
        return [keys.observation, keys.action, unravel_key(("next", keys.observation))]

    def _forward_value_estimator_keys(self, **kwargs) -> None:  # type: ignore[no-untyped-def]
        """This loss has no value estimator."""

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Compute the loss of transitions with any batch shape.

        The tensors may also be given by name (``observation=``, ``action=``,
        ``next_observation=``); the result is then a tuple in the order of ``out_keys``.

        Args:
            tensordict: ``"observation"`` ``[*batch, o]``, ``"action"`` ``[*batch, m]``,
                ``("next", "observation")`` ``[*batch, o]``, and where time steps differ
                ``"time_step"`` ``[*batch, 1]`` in seconds.

        Returns:
            ``loss_prediction`` and ``loss_residual``, whose sum is to be minimised, and the
            detached ``residual_norm``; scalars.
        """
        transition, seconds = self.transitions(tensordict), self.time_step(tensordict)
        error, residual = self.terms(*transition, time_step=seconds)
        loss_prediction = error.square().sum(-1).mean()
        norm = torch.linalg.vector_norm(residual, dim=-1).mean()
        return TensorDict(
            loss_prediction=loss_prediction,
            loss_residual=norm / self.lambda_,
            residual_norm=norm.detach(),
        )

    def transitions(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
        """Return state, action and next state of the transitions in a tensordict.

        The states are those of the system, and the action is what acts on it: the command in
        bounds, behind the task's actuator if it has one.

        Raises:
            ConfigError: for a key that is missing or has another shape than its task and the rest
                of the transitions, and for none at all, whose mean error would be no number.
        """
        task = self.dynamics.task
        seen, command, following = (tensordict.get(key, None) for key in self.in_keys)
        batch = tensordict.batch_size if seen is None else seen.shape[:-1]
        sizes = task.observation_dim, task.action_dim, task.observation_dim
        for key, given, size in zip(self.in_keys, (seen, command, following), sizes, strict=True):
            if given is None or given.shape != (*batch, size):
                name = key if isinstance(key, str) else ".".join(key)
                got = "none" if given is None else f"shape {list(given.shape)}"
                raise ConfigError(name, f"expected shape {[*batch, size]}, got {got}.")
        if not batch.numel():
            raise ConfigError("tensordict", f"expected transitions, got a batch of {list(batch)}.")
        state, registers = task.split(task.locate(seen))
        action, _ = task.acting(registers, command)
        return state, action, task.split(task.locate(following))[0]

    def time_step(self, tensordict: TensorDictBase) -> Tensor | None:
        """Return the time step of each transition ``[*batch, 1]``; ``None`` for the task's."""
        return tensordict.get(self.tensor_keys.time_step, None)

    def terms(
        self,
        state: Tensor,
        action: Tensor,
        next_state: Tensor,
        penalised_action: Tensor | None = None,
        time_step: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return the scaled terms of the two losses: ``s' - ŝ'`` and F^r, each ``[*batch, n]``.

        Args:
            state: states ``[*batch, n]``.
            action: actions ``[*batch, m]``.
            next_state: next states ``[*batch, n]``.
            penalised_action: the actions at which F^r is evaluated, ``[*batch, m]``. Defaults to
                ``action``.
            time_step: seconds, ``[*batch, 1]``. Defaults to the time step of the task.
        """
        error = self.prediction_error(state, action, next_state, time_step) / self.error_scale
        if self.dynamics.residual is None:
            return error, torch.zeros_like(error)
        action = action if penalised_action is None else penalised_action
        return error, self.dynamics.residual(state, action) / self.residual_scale

    def prediction_error(
        self, state: Tensor, action: Tensor, next_state: Tensor, time_step: Tensor | None = None
    ) -> Tensor:
        """``s' - ŝ'`` ``[*batch, n]``, with differences of angles in [-pi, pi)."""
        predicted = self.dynamics.step(state, action, time_step)
        return self.dynamics.task.difference(next_state, predicted)

    @torch.no_grad()
    def update_lambda(self, loss_prediction: Tensor) -> None:
        """Update λ ← λ + τ_ph L_pred, once an epoch."""
        self.lambda_.add_(self.tau_ph * loss_prediction)

    @torch.no_grad()
    def set_scales(self, tensordict: TensorDictBase) -> None:
        """Measure errors, from now on, in units of the one-step changes of these transitions.

        The input and output scales of the residual network are set from the same transitions.

        Args:
            tensordict: transitions of any batch shape.
        """
        tensordict = tensordict.reshape(-1)
        state, action, next_state = self.transitions(tensordict)
        task, seconds = self.dynamics.task, self.time_step(tensordict)
        rate = task.difference(next_state, state) / (task.time_step if seconds is None else seconds)
        size = spread(rate)
        self.error_scale.copy_(size * (task.time_step if seconds is None else seconds.mean()))
        self.residual_scale.copy_(size)
        set_scales = getattr(self.dynamics.residual, "set_scales", None)
        if callable(set_scales):
            set_scales(state, action, rate)
