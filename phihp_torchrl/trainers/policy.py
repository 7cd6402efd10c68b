"""Phase 2: actor and critics learn in imagination (paper, section 4.2)."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor

from phihp_torchrl.agents import (
    ActorCriticUpdate,
    CriticRefit,
    act,
    copy_actor,
    copy_twin_qvalue,
    scaled,
)
from phihp_torchrl.config import resolve_seconds
from phihp_torchrl.dynamics import HybridDynamics, TaskWorldModel, per_life
from phihp_torchrl.imagination import Rollouts, make_start_states, rewarding_states
from phihp_torchrl.tasks import Task
from phihp_torchrl.trainers.drawn_constants import draw_constants
from phihp_torchrl.trainers.floor import Floor
from phihp_torchrl.trainers.learners import LEARNERS, Imagination
from phihp_torchrl.trainers.plateau import Plateau, Schedule
from phihp_torchrl.trainers.policy_config import PolicyConfig
from phihp_torchrl.trainers.policy_evaluation import ActorEvaluation
from phihp_torchrl.trainers.policy_scales import check_scales, training_scales
from phihp_torchrl.worlds import World

# Losses are in these powers of the reward's unit, other metrics have none.
_POWERS = {"loss_actor": 1, "loss_qvalue": 2, "return_range": 1}

# Starts of imagined lives that say which rewards there are.
_WIDE = 4096
# Steps of random actions that lead to starts around those of high reward.
_AROUND = 50


class PolicyTrainer:
    """Phase 2: trains actor and critics in imagination (paper, section 4.2).

    ``config.method`` is the way to learn: TD3, or another that :func:`register_learner` has added.
    Everything else is the same for all of them.

    After every ``evaluation_interval`` updates the noise-free actor is evaluated in the model, from
    the task's reset box, and the best actor so far is kept with its critics: the one that earns
    most, and of several that earn the same, the one whose action changes least. Returns in a
    simulated world are only logged; neither they nor seeds of evaluation affect that choice.

    At the updates that ``config.refit`` sets, the critics of the best actor so far are fitted to
    its returns in the model, unless they were for that actor before, and training continues from
    these. The last fit gives the critics that the planner uses.

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
        compile: whether to compile updates, imagination without plans, and the fit of the critics.
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
        self.task = task
        self.config = config = resolve_seconds(config, task.time_step)
        self.shifts = draw_constants(dynamics, config, covariance, seed)
        model = TaskWorldModel(task, per_life(dynamics, self.shifts))
        found = config.start.rewarding and task.coverage is not None
        best = rewarding_states(model, around=_AROUND, seed=seed) if found else None
        self.start_states = make_start_states(task, config.start, data_states, best)
        start_states = self.start_states
        self.scales = training_scales(model, start_states, config, seed)
        self.world_model = scaled(model, self.scales)
        self.rollouts = Rollouts(self.world_model, act, self.max_age, compile=compile)
        self.schedule = Schedule(config.updates, config.decay)
        self.refit = CriticRefit(
            self.world_model, self.rollouts, config.refit, config.td3.gamma, compile=compile
        )
        self.learner = LEARNERS.find(config.method).build(
            Imagination(
                self.world_model,
                self.rollouts,
                start_states,
                config,
                seed,
                compile,
                self.schedule,
                scaled(TaskWorldModel(task, dynamics), self.scales),
            )
        )
        self.best = [layer.clone() for layer in self._layers()]
        self.best_return = -math.inf
        self.best_change = self.worst_return = math.inf
        self._is_fitted = False  # the best critics, to the best actor's returns
        self.seconds = 0.0
        self.evaluation = ActorEvaluation(
            self.rollouts,
            self.scales,
            config,
            world=world,
            seed=seed,
            generator=self.learner.generator,
            compile=compile,
        )
        self.plateau = None
        if config.patience:
            self.plateau = Plateau(
                self.schedule,
                config.patience,
                config.tail,
                round_to=config.evaluation_interval,
                floor=lambda: self.floor(self.evaluation.states, self.evaluation.steps, seed),
                extension=config.extension,
            )

    @property
    def max_age(self) -> int:
        """Largest number of steps in an imagined episode."""
        return self.config.max_age or self.task.max_steps

    @property
    def update(self) -> ActorCriticUpdate:
        """Actor and critics, which the learner changes."""
        return self.learner.update

    @property
    def updates(self) -> int:
        """Critic updates so far."""
        return self.learner.updates

    @property
    def progress(self) -> tuple[int, int]:
        """Critic updates so far and in all, which a plateau makes fewer and a rise more."""
        return self.updates, self.schedule.end

    @property
    def done(self) -> bool:
        """Whether the updates are made, as many as they now are, or the seconds are spent."""
        return self.updates >= self.schedule.end or self._is_over(self.seconds)

    @torch.no_grad()
    def advance(self) -> dict[str, float]:
        """Train for one evaluation interval and evaluate; returns what to log."""
        start = time.perf_counter()
        config = self.config
        self.start_states.grow(self.updates / config.updates)
        if self.plateau is not None and self.updates == 0:
            self.plateau.see(0, self.evaluation.imagined(self.update.networks.actor).returns)
        end = min(self.updates + config.evaluation_interval, self.schedule.end)
        found = self.learner.learn(end)
        returns, change = self.evaluation.imagined(self.update.networks.actor)
        imagined = self.evaluation.mean(returns)
        if self._is_best(imagined, change):
            self.best_return, self.best_change = imagined, change
            self._keep(self._layers())
            self._is_fitted = False
        self.worst_return = min(self.worst_return, imagined)
        unit = self.scales.reward
        metrics = {
            "policy/updates": float(self.updates),
            "policy/imagined_steps": float(self.learner.imagined_steps),
            "policy/imagined_return": imagined,
            "policy/imagined_change": change,
            "policy/best_imagined_return": self.best_return,
            **{
                f"policy/{name}": unit ** _POWERS.get(name, 0) * value.item()
                for name, value in found.items()
            },
        }
        if self.plateau is not None:
            self.plateau.see(self.updates, returns)
            metrics["policy/end"] = float(self.schedule.end)
        if config.refit.is_due(self.updates, self.schedule.end):
            metrics |= self._refit_critics()
        elif self._is_over(self.seconds + time.perf_counter() - start):
            metrics |= self.finish()
        metrics |= self.evaluation.real(self.update.networks.actor)
        self.seconds += time.perf_counter() - start
        return {**metrics, "policy/seconds": self.seconds}

    def finish(self) -> dict[str, float]:
        """Fit the best actor's critics, if that is set and not done; returns what to log."""
        if not self.config.refit.interval or self._is_fitted or self.best_return == -math.inf:
            return {}
        return self._refit_critics()

    def floor(self, states: Tensor, steps: int, seed: int) -> Floor:
        """The floor of returns of ``steps`` steps from these states, in the units of training."""
        wide = self.start_states.sample([_WIDE], torch.Generator().manual_seed(seed))
        return Floor(self.world_model, states, steps, seed=seed, wide=wide)

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

    def trained(self) -> dict[str, Tensor]:
        """The layers of actor and critics, their targets and moments, by name."""
        groups = self.update.networks._asdict().items()
        return {f"{name}.{i}": layer for name, group in groups for i, layer in enumerate(group)}

    def state_dict(self) -> dict[str, Any]:
        """Everything that a resumed run needs, tensors and numbers only."""
        return {
            **self.learner.state_dict(),
            "seconds": self.seconds,
            "scales": vars(self.scales).copy(),
            "best": list(self.best),
            "best_return": self.best_return,
            "best_change": self.best_change,
            "worst_return": self.worst_return,
            "is_fitted": self._is_fitted,
            "evaluation_states": self.evaluation.states,
            "world_states": self.evaluation.world_states,
            **({} if self.shifts is None else {"shifts": self.shifts}),
            **({} if self.plateau is None else {"plateau": self.plateau.state_dict()}),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state_dict`.

        Raises:
            ConfigError: if that was trained in other units than those measured here.
        """
        check_scales(self.task, self.scales, state.get("scales"))
        self.learner.load_state_dict(state)
        self.seconds = state["seconds"]
        for kept, layer in zip(self.best, state["best"], strict=True):
            kept.copy_(layer)
        if self.shifts is not None:
            self.shifts.copy_(state["shifts"])  # the same to the last digit on another machine
        if self.plateau is not None and "plateau" in state:  # older checkpoints go to their end
            self.plateau.load_state_dict(state["plateau"])
        self.best_return = state["best_return"]
        self.best_change = state.get("best_change", math.inf)  # older checkpoints do not say
        self.worst_return = state.get("worst_return", math.inf)
        self._is_fitted = state.get("is_fitted", False)  # older checkpoints fit again
        self.evaluation.states = state["evaluation_states"]
        self.evaluation.world_states = state["world_states"]

    def _is_best(self, imagined: float, change: float) -> bool:
        """Whether an actor is the one to keep so far; none is that left the finite numbers.

        Of those with equal returns it is the one whose action changes least, where every step
        earns the same and most actors earn all. Where all earn as little as the first, it is the
        latest, which has learned more.
        """
        if imagined == self.best_return > self.worst_return:
            return change <= self.best_change
        return -math.inf < imagined >= self.best_return

    def _is_over(self, seconds: float) -> bool:
        """Whether the seconds are spent."""
        limit = self.config.max_seconds
        return limit is not None and seconds > limit

    def _keep(self, layers: list[Tensor]) -> None:
        for kept, layer in zip(self.best, layers, strict=True):
            kept.copy_(layer)

    def _refit_critics(self) -> dict[str, float]:
        """Fit the best actor's critics to its returns, once, and go on from these."""
        count = len(self.update.networks.actor)
        actor, critics = self.best[:count], self.best[count:]
        if self._is_fitted:
            self.update.restart(actor, critics)
            return {}
        visited = self.learner.visited(self.config.refit.transitions)
        refit = self.refit(actor, critics, *visited, self.learner.generator)
        self._keep([*actor, *refit.critics])
        self._is_fitted = True
        self.update.restart(actor, refit.critics)
        return {
            "policy/critic_lag": self.scales.reward * refit.lag,
            "policy/critic_error_before": self.scales.reward * refit.error_before,
            "policy/critic_error": self.scales.reward * refit.error_after,
        }

    def _layers(self) -> list[Tensor]:
        return [*self.update.actor, *self.update.critics]
