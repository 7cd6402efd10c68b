"""Phase 2: TD3 in imagination (paper, section 4.2)."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor

from phihp_torchrl.agents import (
    CriticRefit,
    FlatReplay,
    Scales,
    act,
    copy_actor,
    copy_twin_qvalue,
    learning_rate_scale,
    measure_scales,
    scaled,
    visited_states,
)
from phihp_torchrl.config import (
    ConfigError,
)
from phihp_torchrl.dynamics import (
    HybridDynamics,
    PhysicsPrior,
    TaskWorldModel,
    draw_shifts,
    per_life,
)
from phihp_torchrl.imagination import Rollouts, Worlds, make_start_states
from phihp_torchrl.tasks import Task
from phihp_torchrl.trainers.context import Context
from phihp_torchrl.trainers.phases import Phase, register_phase
from phihp_torchrl.trainers.policy_config import PolicyConfig
from phihp_torchrl.trainers.td3_base import TD3Trainer
from phihp_torchrl.worlds import World

_log = logging.getLogger(__name__)


class PolicyTrainer(TD3Trainer):
    """Phase 2: trains actor and critics by TD3 in imagination (paper, section 4.2).

    After every ``evaluation_interval`` updates the noise-free actor is evaluated in the model, from
    the task's reset box, and the best actor so far is kept with its critics. Returns in a simulated
    world are only logged; neither they nor seeds of evaluation affect that choice.

    At the updates that ``config.refit`` sets, the critics of the best actor so far are fitted to
    its returns in the model, and training continues from these. The last fit gives the critics that
    the planner uses.

    With ``config.scales`` the networks are trained in units that are measured from the task's
    coverage. The actors and critics that this returns, and its metrics, are in physical units.

    An ensemble of residuals, and constants with ``config.draw_constants``, are dealt out to the
    imagined worlds (:func:`~phihp_torchrl.dynamics.per_life`), also when the actor to keep is
    chosen and the critics are fitted. So the actor kept is the one that earns most over all models
    which the data allow.

    Args:
        task: the task.
        dynamics: the model to imagine with; it is not changed.
        config: settings of phase 2.
        world: the real world; if it is simulated, the actor's returns in it are logged.
        seed: seed of all random numbers but the initial weights of the networks, which come from
            torch's global generator.
        data_states: states of real transitions ``[N, n]``, for ``start.data`` > 0.
        compile: whether to compile the TD3 step, imagination, and the fit of the critics.
        covariance: covariance of the model's learned constants, for ``config.draw_constants``
            without ``config.constants_std``.

    Raises:
        ConfigError: for constants to draw without their covariance, or that are not learned.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> from phihp_torchrl.agents import RefitConfig
        >>> task = get_task("pendulum")
        >>> config = PolicyConfig(
        ...     updates=4,
        ...     evaluation_interval=4,
        ...     evaluation_steps=5,
        ...     refit=RefitConfig(interval=0),
        ... )
        >>> trainer = PolicyTrainer(task, HybridDynamics.hybrid(task), config, seed=0)
        >>> while not trainer.done:
        ...     metrics = trainer.advance()
        >>> trainer.best_actor().out_keys
        ['action']
    """

    def __init__(
        self,
        task: Task,
        dynamics: HybridDynamics,
        config: PolicyConfig,
        *,
        world: World | None = None,
        seed: int,
        data_states: Tensor | None = None,
        compile: bool = False,
        covariance: Tensor | None = None,
    ) -> None:
        self.task, self.config = task, config
        self.shifts = _draw(dynamics, config, covariance, seed)
        self.start_states = make_start_states(task, config.start, states=data_states)
        model = TaskWorldModel(task, per_life(dynamics, self.shifts))
        self.scales = self._measure(model, seed)
        self.world_model = scaled(model, self.scales)
        super().__init__(self.world_model, config.td3, seed=seed, compile=compile)
        self.rollouts = Rollouts(self.world_model, act, self.max_age, compile=compile)
        self.refit = CriticRefit(
            self.world_model, self.rollouts, config.refit, config.td3.gamma, compile=compile
        )
        self.replay = FlatReplay(config.replay_capacity, task.state_dim, task.action_dim)
        self._enter(self._new_worlds())
        self.best = [layer.clone() for layer in (*self.update.actor, *self.update.critics)]
        self.best_return = -math.inf
        self._evaluation_states = task.sample_start([config.evaluation_episodes], self.generator)
        self._evaluation_signals = self._draw_signals(config.evaluation_episodes, seed)
        truth = None if world is None else world.model()
        self._real = None
        if truth is not None:
            world_model = scaled(truth, self.scales)
            self._real = Rollouts(world_model, act, self.max_age, compile=compile)
        # The world's episodes have a generator of their own: the log has no part in the training.
        self._world_states = task.sample_start(
            [config.real_evaluation_episodes], torch.Generator().manual_seed(seed)
        )
        self._world_signals = self._draw_signals(config.real_evaluation_episodes, seed)

    @property
    def max_age(self) -> int:
        """Largest number of steps in an imagined episode."""
        return self.config.max_age or self.task.max_steps

    @property
    def progress(self) -> tuple[int, int]:
        """Critic updates so far and in all."""
        return self.updates, self.config.updates

    @property
    def done(self) -> bool:
        """Whether the budget of updates or seconds is spent."""
        limit = self.config.max_seconds
        return self.updates >= self.config.updates or (limit is not None and self.seconds > limit)

    @torch.no_grad()
    def advance(self) -> dict[str, float]:
        """Train for one evaluation interval and evaluate; returns what to log."""
        start = time.perf_counter()
        config = self.config
        until = min(self.updates + config.evaluation_interval, config.updates)
        losses: dict[str, Tensor] = {}
        while self.updates < until:
            round_end = config.chunk_steps * config.updates_per_step
            if self.updates % round_end == 0:
                self._imagine_chunk()
            for _ in range(min(round_end - self.updates % round_end, until - self.updates)):
                if self.updates % config.td3.policy_delay == 0:
                    left = 1.0 - self.updates / config.updates
                    scale = learning_rate_scale(left, config.decay)
                    losses = self._learn(config.batch_size, scale)
                self.updates += 1
        imagined = self._play(self.rollouts, self._evaluation_states, self._evaluation_signals)
        # Of equal ones the later, which has learned more; none that left the finite numbers.
        if -math.inf < imagined >= self.best_return:
            self.best_return = imagined
            self._keep(self._layers())
        metrics = {
            "policy/updates": float(self.updates),
            "policy/imagined_steps": float(self.replay.written),
            "policy/imagined_return": imagined,
            "policy/best_imagined_return": self.best_return,
            **{f"policy/{name}": self._unit(name) * loss.item() for name, loss in losses.items()},
        }
        if config.refit.is_due(self.updates, config.updates):
            metrics |= self._refit_critics()
        if config.real_evaluation_episodes and self._real is not None:
            metrics["policy/real_return"] = self._play(
                self._real, self._world_states, self._world_signals
            )
        self.seconds += time.perf_counter() - start
        return {**metrics, "policy/seconds": self.seconds}

    def actor(self) -> TensorDictModule:
        """The actor as it is now."""
        return copy_actor(self.task, self.scales.actor(self.update.actor))

    def best_actor(self) -> TensorDictModule:
        """The actor with the best imagined return so far."""
        return copy_actor(self.task, self.scales.actor(self.best[: len(self.update.actor)]))

    def best_qvalue(self) -> TensorDictModule:
        """The twin critics that were the best actor's."""
        critics = self.best[len(self.update.actor) :]
        return copy_twin_qvalue(self.task, self.scales.critics(critics))

    def parts(self) -> dict[str, Any]:
        """Actor and critics, as arguments of :class:`~phihp_torchrl.deployment.Agent`."""
        return {"actor": self.best_actor(), "qvalue": self.best_qvalue()}

    def state_dict(self) -> dict[str, Any]:
        """Everything that a resumed run needs, tensors and numbers only."""
        return {
            **super().state_dict(),
            "scales": vars(self.scales).copy(),
            "best": list(self.best),
            "best_return": self.best_return,
            "evaluation_states": self._evaluation_states,
            "world_states": self._world_states,
            **({} if self.shifts is None else {"shifts": self.shifts}),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state_dict`.

        Raises:
            ConfigError: if that was trained in other units than those measured here.
        """
        self._check_scales(state.get("scales"))
        super().load_state_dict(state)
        for kept, layer in zip(self.best, state["best"], strict=True):
            kept.copy_(layer)
        if self.shifts is not None:
            self.shifts.copy_(state["shifts"])  # the same to the last digit on another machine
        self.best_return = state["best_return"]
        self._evaluation_states = state["evaluation_states"]
        self._world_states = state["world_states"]

    def _measure(self, model: TaskWorldModel, seed: int) -> Scales:
        """The units to train in; they have a generator of their own, which moves nothing else."""
        task, config = self.task, self.config
        if config.scales == "none":
            size = task.observation_dim
            return Scales(torch.zeros(size), torch.ones(size))
        generator = torch.Generator().manual_seed(seed)
        states = visited_states(model, self.start_states, min(self.max_age, 200), generator)
        gamma = config.td3.gamma
        horizon = self.max_age if gamma == 1 else min(self.max_age, 1 / (1 - gamma))
        scales = measure_scales(model, states, horizon, generator)
        if not scales.are_one:
            _log.info(
                "Networks read (observation - %s) / %s and learn rewards / %g.",
                scales.center.tolist(),
                scales.scale.tolist(),
                scales.reward,
            )
        return scales

    def _check_scales(self, saved: Mapping[str, Any] | None) -> None:
        size = self.task.observation_dim
        there = Scales(**saved) if saved else Scales(torch.zeros(size), torch.ones(size))
        same = all(
            torch.equal(torch.as_tensor(getattr(there, name)), torch.as_tensor(value))
            for name, value in vars(self.scales).items()
        )
        if not same:
            raise ConfigError(
                "policy.scales",
                f"expected networks trained in the units measured here, {self.scales}, got some "
                f"trained in {there}; start phase 'policy' again, with policy.scales=none for "
                "physical units.",
            )

    def _unit(self, name: str) -> float:
        """The unit of a loss: critics' is squared."""
        return self.scales.reward ** (2 if name == "loss_qvalue" else 1)

    @property
    def _evaluation_steps(self) -> int:
        return self.config.evaluation_steps or self.task.max_steps

    def _draw_signals(self, episodes: int, seed: int) -> Tensor | None:
        """References and inputs of episodes, ``[1 + steps, episodes, size]``, if there are any."""
        if not self.task.outside:
            return None
        generator, steps = torch.Generator().manual_seed(seed), 1 + self._evaluation_steps
        drawn = self.task.outside.draw([episodes], steps, generator)
        return self.task.outside.windows(drawn, 0, steps)

    def _play(self, world: Rollouts, states: Tensor, signals: Tensor | None) -> float:
        """Mean return of the noise-free actor; minus infinity where it left the finite numbers."""
        later = None
        if signals is not None:
            states, later = self.task.with_signals(states, signals[0]), signals[1:]
        actor, steps = self.update.networks.actor, self._evaluation_steps
        score = world.returns(actor, states, steps, signals=later).total
        return self.scales.reward * torch.nan_to_num(score, nan=-math.inf).mean().item()

    def _keep(self, layers: list[Tensor]) -> None:
        for kept, layer in zip(self.best, layers, strict=True):
            kept.copy_(layer)

    def _refit_critics(self) -> dict[str, float]:
        """Fit the best actor's critics to its returns, and go on from these."""
        count = len(self.update.networks.actor)
        actor, critics = self.best[:count], self.best[count:]
        batch = self.replay.sample(self.config.refit.transitions, self.generator)
        refit = self.refit(actor, critics, batch.state, batch.action, self.generator)
        self._keep([*actor, *refit.critics])
        self.update.restart(actor, refit.critics)
        return {
            "policy/critic_lag": self.scales.reward * refit.lag,
            "policy/critic_error_before": self.scales.reward * refit.error_before,
            "policy/critic_error": self.scales.reward * refit.error_after,
        }

    def _layers(self) -> list[Tensor]:
        return [*self.update.actor, *self.update.critics]

    def _new_worlds(self) -> Worlds:
        count = self.config.num_worlds
        age = torch.randint(self.max_age, (count,), generator=self.generator)
        return Worlds(self.start_states.sample([count], self.generator), age)

    def _imagine_chunk(self) -> None:
        config = self.config
        while True:
            warm = len(self.replay) >= config.random_steps
            self._act(
                self.rollouts,
                self.start_states.sample([config.chunk_steps, config.num_worlds], self.generator),
                noise=config.exploration_noise,
                random_fraction=config.random_fraction if warm else 1.0,
            )
            if warm:
                return


def _draw(
    dynamics: HybridDynamics, config: PolicyConfig, covariance: Tensor | None, seed: int
) -> Tensor | None:
    """Shifts of the constants of each imagined world, ``[worlds, learned]``, if there are any."""
    if not config.draw_constants:
        return None
    prior = getattr(dynamics, "prior", None)
    if not isinstance(prior, PhysicsPrior) or not prior.learned:
        raise ConfigError(
            "policy.draw_constants", "expected false for a model without learned constants."
        )
    if config.constants_std is not None:
        covariance = config.constants_std**2 * torch.eye(len(prior.learned))
    if covariance is None:
        raise ConfigError(
            "policy.draw_constants",
            "expected the covariance of the constants, or policy.constants_std, got neither.",
        )
    # The draws have a generator of their own, so that everything else is as without them.
    return draw_shifts(covariance, config.num_worlds, torch.Generator().manual_seed(seed))


def _build(context: Context) -> Phase:
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


register_phase("policy", PolicyConfig, _build, unit="updates")
