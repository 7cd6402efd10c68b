"""Phase 1: collect, fit, plan and collect (paper, section 4.1 and appendix C)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.envs import EnvBase

from phihp_torchrl.agents import Batch
from phihp_torchrl.dynamics import (
    BLOCK,
    DynamicsLoss,
    FitConfig,
    HybridDynamics,
    PhysicsPrior,
    fit,
    perturbed_constants,
    rollout_error,
    split,
)
from phihp_torchrl.tasks import Task
from phihp_torchrl.trainers.collect import (
    CollectConfig,
    make_real_env,
    planning_policy,
    random_policy,
)

_ACTIVATIONS: dict[str, type[nn.Module]] = {"relu": nn.ReLU, "tanh": nn.Tanh, "silu": nn.SiLU}


@dataclass(frozen=True)
class ModelConfig:
    """Phase 1.

    Args:
        real_steps: real transitions in all. An oracle, which has nothing to learn, may take none.
        steps_per_iteration: real transitions between two fits, T; ``None`` for a tenth of all of
            them, but no fewer than 50.
        kind: ``"hybrid"``, ``"data_driven"``, ``"prior"`` or ``"oracle"``.
        constants_error: relative error of the prior's first guess, signs drawn by the seed.
        hidden_sizes: widths of the residual's hidden layers.
        activation: of the residual: ``"tanh"``, ``"silu"`` or ``"relu"``.
        residual_outputs: ``"velocities"`` or ``"all"`` (see :meth:`HybridDynamics.hybrid`).
        integrator: of the model.
        lambda_0: initial weight λ of the published loss.
        tau_ph: its growth.
        warm_start: whether a fit starts from the one before. Those between the first and the last
            then keep λ where it ended, and take at most ``refit_steps``.
        refit_steps: see ``warm_start``.
        fit: how to fit.
        collect: how to collect.
    """

    real_steps: int = 5000
    steps_per_iteration: int | None = None
    kind: str = "hybrid"
    constants_error: float = 0.3
    hidden_sizes: tuple[int, ...] = (16, 16)
    activation: str = "tanh"
    residual_outputs: str = "velocities"
    integrator: str = "semi_implicit_euler"
    lambda_0: float = 1e3
    tau_ph: float = 1e3
    warm_start: bool = True
    refit_steps: int = 15
    fit: FitConfig = field(default_factory=FitConfig)
    collect: CollectConfig = field(default_factory=CollectConfig)

    def __post_init__(self) -> None:
        for name in ("real_steps", "steps_per_iteration", "refit_steps"):
            value, least = getattr(self, name), 1
            if name == "real_steps" and self.kind == "oracle":
                least = 0
            if value is not None and value < least:
                raise ValueError(f"{name}: expected a number >= {least}, got {value}.")
        if self.kind not in ("hybrid", "data_driven", "prior", "oracle"):
            raise ValueError(
                f"kind: expected 'hybrid', 'data_driven', 'prior' or 'oracle', got {self.kind!r}."
            )
        if self.residual_outputs not in ("velocities", "all"):
            raise ValueError(
                f"residual_outputs: expected 'velocities' or 'all', got {self.residual_outputs!r}."
            )
        if self.activation not in _ACTIVATIONS:
            raise ValueError(
                f"activation: expected one of {sorted(_ACTIVATIONS)}, got {self.activation!r}."
            )

    @property
    def period(self) -> int:
        """Real transitions between two fits, T."""
        return self.steps_per_iteration or max(50, -(-self.real_steps // 10))

    @property
    def iterations(self) -> int:
        """Number of fits."""
        return -(-self.real_steps // self.period)


def make_dynamics(
    task: Task, config: ModelConfig, generator: torch.Generator | None = None
) -> HybridDynamics:
    """The model of ``config``, untrained.

    Args:
        task: the task.
        config: phase 1.
        generator: source of the signs of the first guess's errors. The networks' initial weights
            come from torch's global generator.
    """
    if config.kind == "oracle":
        return HybridDynamics.oracle(task)
    activation, sizes = _ACTIVATIONS[config.activation], config.hidden_sizes
    if config.kind == "data_driven":
        return HybridDynamics.data_driven(
            task, hidden_sizes=sizes, activation=activation, integrator=config.integrator
        )
    guess = perturbed_constants(task.system, config.constants_error, generator)
    if config.kind == "prior":
        return HybridDynamics.pure_prior(task, constants=guess, integrator=config.integrator)
    return HybridDynamics.hybrid(
        task,
        constants=guess,
        hidden_sizes=sizes,
        activation=activation,
        residual_outputs=config.residual_outputs,
        integrator=config.integrator,
    )


class ModelTrainer:
    """Learns the model from real steps: random steps, fit, planned steps, fit, and so on.

    Args:
        task: the task.
        config: phase 1.
        env: the real world, with batch size ``[]``. Defaults to the task's gymnasium world.
        seed: of everything random here.

    Raises:
        ValueError: if the environment lacks ``"observation"`` or ``"action"``.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> config = ModelConfig(real_steps=100, steps_per_iteration=50, fit=FitConfig(steps=5))
        >>> trainer = ModelTrainer(get_task("pendulum"), config, seed=0)
        >>> while not trainer.done:
        ...     metrics = trainer.advance()
        >>> trainer.real_steps
        100
    """

    def __init__(
        self, task: Task, config: ModelConfig, *, seed: int, env: EnvBase | None = None
    ) -> None:
        self.task = task
        self.config = config
        self.env = make_real_env(task) if env is None else env
        for key in ("observation", "action"):
            if key not in (*self.env.observation_spec.keys(), *self.env.full_action_spec.keys()):
                raise ValueError(f"env: expected an environment with {key!r}, got {self.env}.")
        self.generator = torch.Generator().manual_seed(seed)
        self.dynamics = make_dynamics(task, config, self.generator)
        self.initial = {k: v.clone() for k, v in self.dynamics.state_dict().items()}
        self.loss = DynamicsLoss(self.dynamics, lambda_0=config.lambda_0, tau_ph=config.tau_ph)
        self.data: TensorDict | None = None
        self.iteration = 0
        self.env.set_seed(self._draw_seed())

    @property
    def real_steps(self) -> int:
        """Real transitions so far."""
        return 0 if self.data is None else len(self.data)

    @property
    def progress(self) -> tuple[int, int]:
        """Real transitions so far and in all."""
        return self.real_steps, self.config.real_steps

    @property
    def done(self) -> bool:
        """Whether all real transitions are collected and fitted."""
        return self.real_steps >= self.config.real_steps

    def states(self) -> Tensor:
        """All states seen, ``[N, n]``."""
        return self.transitions().state

    def transitions(self) -> Batch:
        """All real transitions, ``[N]``, as replay buffers take them."""
        if self.data is None:
            system = self.task.system
            state, action = torch.zeros(0, system.state_dim), torch.zeros(0, system.action_dim)
            return Batch(state, action, torch.zeros(0), state, torch.zeros(0, dtype=torch.bool))
        state, action, next_state = self.loss.transitions(self.data)
        # The data's "done" has truncations among it, after which values go on.
        terminated = self.task.is_terminated(next_state)
        return Batch(state, action, self.data["next", "reward"][:, 0], next_state, terminated)

    def parts(self) -> dict[str, Any]:
        """The model, as an argument of :class:`~phihp_torchrl.deployment.Agent`."""
        return {"dynamics": self.dynamics}

    def advance(self) -> dict[str, float]:
        """Collect once and fit once; returns what to log."""
        steps = min(self.config.period, self.config.real_steps - self.real_steps)
        new = self.collect(steps)
        self.data = new if self.data is None else torch.cat([self.data, new])
        self.iteration += 1
        metrics = {"real_steps": self.real_steps, "collect/reward": new["next", "reward"].mean()}
        if self.config.kind != "oracle":
            metrics |= self.fit()
        return {name: float(value) for name, value in metrics.items()}

    def collect(self, steps: int) -> TensorDict:
        """Take real steps: at random in the first iteration, with the planner in later ones."""
        config, generator = self.config, self.generator
        if self.iteration == 0:
            policy = random_policy(self.task, config.collect, generator)
        else:
            fade = max(0.0, 1.0 - (self.iteration - 1) / max(1, config.iterations - 2))
            policy = planning_policy(
                self.task, self.dynamics, config.collect, generator, fade * config.collect.noise
            )
        # A seed of its own for every iteration: a resumed run sees the same resets.
        self.env.set_seed(self._draw_seed())
        with torch.no_grad():
            rollout = self.env.rollout(steps, policy, break_when_any_done=False)
        done = rollout["next", "done"].clone()
        done[-1] = True  # the next rollout starts from a reset
        return TensorDict(
            observation=rollout["observation"].float(),
            action=rollout["action"].float(),
            next=TensorDict(
                observation=rollout["next", "observation"].float(),
                reward=rollout["next", "reward"].float(),
                done=done,
                batch_size=[steps],
            ),
            batch_size=[steps],
        ).detach()

    def fit(self) -> dict[str, Tensor | float]:
        """Fit the model to all data and measure it."""
        config = self.config.fit
        if not self.config.warm_start:
            self.dynamics.load_state_dict(self.initial)
            self.loss.lambda_.fill_(self.config.lambda_0)
        elif self.iteration > 1 and not self.done:
            config = replace(
                config,
                steps=min(config.steps, self.config.refit_steps),
                initial_lambda=config.final_lambda,
            )
        train, held_out, blocks = split(self.data)
        report = fit(self.loss, train, held_out, config, self.generator)
        state, action, _ = self.loss.transitions(train)
        metrics: dict[str, Tensor | float] = {
            "model/train_error": report.train_error,
            "model/held_out_error": report.held_out_error,
            "model/fit_steps": report.steps,
            "model/fit_seconds": report.seconds,
            "model/lambda": self.loss.lambda_,
            "model/residual_share": self.dynamics.residual_share(state, action),
        }
        if blocks is not None:
            metrics[f"model/rollout_error_{BLOCK}"] = rollout_error(self.loss, blocks)
        if isinstance(self.dynamics.prior, PhysicsPrior):
            constants = self.dynamics.prior.constants()
            for name, value in self.task.system.identifiable(constants).items():
                metrics[f"constants/{name}"] = value.detach()
        return metrics

    def state_dict(self) -> dict[str, Any]:
        """Everything that a resumed run needs, tensors and numbers only."""
        return {
            "dynamics": self.dynamics.state_dict(),
            "initial": self.initial,
            "loss": {name: buffer for name, buffer in self.loss.named_buffers(recurse=False)},
            "data": None if self.data is None else self.data.to_dict(),
            "iteration": self.iteration,
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from :meth:`state_dict`."""
        self.dynamics.load_state_dict(state["dynamics"])
        self.initial = dict(state["initial"])
        for name, value in state["loss"].items():
            self.loss.get_buffer(name).copy_(value)
        data = state["data"]
        self.data = None if data is None else TensorDict(data).auto_batch_size_(1)
        self.iteration = state["iteration"]
        self.generator.set_state(state["generator"])

    def _draw_seed(self) -> int:
        return int(torch.randint(2**31, (), generator=self.generator))
