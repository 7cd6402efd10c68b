"""Phase 1: collect, fit, plan and collect (paper, section 4.1 and appendix C)."""

from __future__ import annotations

import copy
import logging
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import Compose, TransformedEnv

from phihp_torchrl.config import (
    ConfigError,
)
from phihp_torchrl.dynamics import (
    AUTO,
    BLOCK,
    SOLVERS,
    DynamicsLoss,
    FitConfig,
    FitReport,
    PhysicsPrior,
    constants_covariance,
    fit,
    fit_solver,
    rollout_error,
    split,
    successive_correlation,
)
from phihp_torchrl.imagination import Batch
from phihp_torchrl.recordings import transitions
from phihp_torchrl.tasks import Actuator, Task
from phihp_torchrl.trainers.collect import (
    drop_unusable,
    planning_policy,
    random_policy,
    steady,
    within_rate,
)
from phihp_torchrl.trainers.context import Context
from phihp_torchrl.trainers.exploration import Exploration
from phihp_torchrl.trainers.lateness import Lateness
from phihp_torchrl.trainers.model_config import ModelConfig, make_dynamics
from phihp_torchrl.trainers.phases import Phase, register_phase
from phihp_torchrl.worlds import (
    World,
    command_memory,
    crossings_text,
    disagreements,
    guard_env,
    make_world,
)

_log = logging.getLogger(__name__)

_SAME_STEP = 1e-3
"""Recorded time steps within this share of the task's are the task's."""


class ModelTrainer:
    """Phase 1: learns the model from real steps (paper, section 4.1 and appendix C).

    It alternates between collecting real steps, at random in the first iteration and by planning
    in later ones, and fitting the model. In a world that has recordings alone, it fits the model
    once, to all their transitions.

    Steps of which a number is missing are left out, with a warning. A run saves new steps before it
    fits the model to them, so that a fit that fails costs no step.

    Where the task has no actuator and previous commands explain what the first or the last fit
    leaves over, a dead time and a lag are chosen by held-out error. :attr:`task` and :attr:`world`
    then have them, and later phases of a run go on with these.

    Args:
        task: the task.
        config: settings of phase 1.
        seed: seed of all random numbers of this phase.
        world: the real world, in any form that :func:`~phihp_torchrl.make_world` accepts. Defaults
            to the simulated world of the task.

    Raises:
        ConfigError: for a world that does not fit the task, and for an oracle in a world that is
            not simulated.

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
        self, task: Task, config: ModelConfig, *, seed: int, world: Any = "simulated"
    ) -> None:
        self.task = task
        self.config = config
        self.world = make_world(task, world)
        self.exploration = Exploration(task, config.collect.exploration)
        self.crossings: Counter[str] = Counter()
        self.env = None
        if self.world.has_env:
            guards = config.collect.exploration.guards
            self.env = guard_env(self.world.make_env(), task, guards, self.crossings)
        self.recorded = _recorded(self.world)
        self.lateness = Lateness(task, self.world, config.actuator, config.fit)
        self.generator = torch.Generator().manual_seed(seed)
        self.dynamics = make_dynamics(self.world, config, self.generator)
        self.initial = {k: v.clone() for k, v in self.dynamics.state_dict().items()}
        self.loss = DynamicsLoss(self.dynamics, lambda_0=config.lambda_0, tau_ph=config.tau_ph)
        self.data: TensorDict | None = None
        self.iteration = 0
        self.keep: Callable[[], None] | None = None
        """What saves the run; it is called when there are new real steps."""
        self._new, self._dropped = 0, 0  # steps not yet fitted, and those left out
        self._told: set[str] = set()
        self._found: Actuator | None = None
        seed_of_env = self._draw_seed()
        if self.env is not None:
            self.env.set_seed(seed_of_env)

    @property
    def real_steps(self) -> int:
        """Real steps so far, with those that were left out."""
        return self._dropped + (0 if self.data is None else len(self.data))

    @property
    def progress(self) -> tuple[int, int]:
        """Real steps so far and in all."""
        total = self.config.real_steps if self.recorded is None else len(self.recorded)
        return self.real_steps, total

    @property
    def done(self) -> bool:
        """Whether all real transitions are collected and fitted."""
        return self._has_all and not self._new

    @property
    def _has_all(self) -> bool:
        steps, total = self.progress
        return steps >= total

    def states(self) -> Tensor:
        """Return all states of the real data, ``[N, n]``."""
        return self.transitions().state

    def transitions(self) -> Batch:
        """Return all real transitions, ``[N]``, as replay keeps them: with rewards less prices."""
        if self.data is None:
            state = torch.zeros(0, self.task.state_dim)
            action = torch.zeros(0, self.task.action_dim)
            return Batch(state, action, torch.zeros(0), state, torch.zeros(0, dtype=torch.bool))
        state = self.task.locate(self.data["observation"])
        next_state = self.task.locate(self.data["next", "observation"])
        action = self.data["action"]
        # "done" in the data includes truncations, which are not terminations.
        command = self.task.command(self.task.split(state)[1], action)
        terminated = self.task.is_terminated(next_state, command)
        reward = self.data["next", "reward"][:, 0]
        price = self.task.price(state, action, next_state)
        reward = reward if price is None else reward - price
        return Batch(state, action, reward, next_state, terminated)

    def constants_covariance(self) -> Tensor:
        """Covariance of the prior's learned constants after the last fit, ``[learned, learned]``.

        Raises:
            ConfigError: before the first fit, and as
                :func:`~phihp_torchrl.dynamics.constants_covariance`.
        """
        if self.data is None:
            raise ConfigError("real_steps", "expected real steps that were fitted, got none.")
        train, held_out, _ = split(self.data)
        return constants_covariance(self.loss, train, held_out)

    def parts(self) -> dict[str, Any]:
        """Return the model, as an argument of :class:`~phihp_torchrl.Agent`."""
        return {"dynamics": self.dynamics}

    def advance(self) -> dict[str, float]:
        """Collect once and fit once; returns metrics."""
        if not self._new:  # else a fit has failed, and is tried again on the same steps
            steps = min(self.config.period, self.config.real_steps - self.real_steps)
            new = self.collect(steps) if self.recorded is None else self.recorded
            self.data = new if self.data is None else torch.cat([self.data, new])
            self.iteration += 1
            self._new = len(new)
            if self.keep is not None:
                self.keep()
        assert self.data is not None
        self._tell_disagreements()
        reward = self.data["next", "reward"][-self._new :].mean()
        metrics = {"real_steps": self.real_steps, "collect/reward": reward}
        if self.config.collect.exploration.guards:
            metrics["collect/guard_crossings"] = self.crossings.total()
        if self._dropped:
            metrics["collect/dropped"] = self._dropped
        if self.config.kind != "oracle":
            metrics |= self.fit()
        self._new = 0
        return {name: float(value) for name, value in metrics.items()}

    def collect(self, steps: int) -> TensorDict:
        """Take real steps: at random in the first iteration, with the planner in later ones.

        Raises:
            ConfigError: for a world of recordings, and if too many steps miss a number.
        """
        if self.env is None:
            raise ConfigError("world", f"{self.world} has recordings alone, nobody can act in it.")
        config, generator = self.config, self.generator
        if self.iteration == 0:
            policy = random_policy(self.task, config.collect, generator, self.exploration)
        else:
            fade = max(0.0, 1.0 - (self.iteration - 1) / max(1, config.iterations - 2))
            noise = fade * config.collect.noise
            policy = planning_policy(
                self.task, self.dynamics, config.collect, generator, noise, self.exploration
            )
        # Each iteration has its seed, so that a resumed run has the same resets.
        self.env.set_seed(self._draw_seed())
        self.crossings.clear()
        with torch.no_grad():
            policy = within_rate(self.task, steady(self.task, policy))
            rollout = self.env.rollout(steps, policy, break_when_any_done=False)
        self._tell_crossings(steps)
        done = rollout["next", "done"].clone()
        done[-1] = True  # the next rollout starts from a reset
        data = TensorDict(
            observation=rollout["observation"].float(),
            action=rollout["action"].float(),
            next=TensorDict(
                observation=rollout["next", "observation"].float(),
                reward=rollout["next", "reward"].float(),
                done=done,
                terminated=rollout["next", "terminated"],
                batch_size=[steps],
            ),
            batch_size=[steps],
        ).detach()
        if self.lateness.open:
            data["step_count"] = rollout["step_count"]
        data, dropped = drop_unusable(data)
        self._dropped += dropped
        return data

    def _tell_crossings(self, steps: int) -> None:
        """Warn where guards ended episodes."""
        if self.crossings:
            _log.warning(
                "Guards ended %d episodes in %d real steps (%s). If the plant should not come near "
                "them, lower model.collect.exploration.amplitude or rate, or explore around a "
                "controller (model.collect.exploration.controller).",
                self.crossings.total(),
                steps,
                crossings_text(self.crossings),
            )

    def _tell_disagreements(self) -> None:
        """Warn where real transitions contradict the task, when first seen and at the end."""
        if self.world.truth is not None or self.data is None:
            return
        for sentence in disagreements(self.task, self.data):
            about = sentence.split(" of ")[0].rstrip("0123456789 ")
            if about not in self._told or self._has_all:
                self._told.add(about)
                _log.warning("After %d real steps: %s.", self.real_steps, sentence)

    def fit(self) -> dict[str, Tensor | float]:
        """Fit the model to all data and measure it."""
        config = self.config.fit
        if not self.config.warm_start:
            self._begin_again()
        elif self.iteration > 1 and not self._has_all:
            config = replace(
                config,
                steps=min(config.steps, self.config.refit_steps),
                initial_lambda=config.final_lambda,
            )
        assert self.data is not None
        train, held_out, blocks = split(self.data)
        report = self._fit(train, held_out, config)
        if self._finds_actuator(report):
            train, held_out, blocks = split(self.data)
            report = self._fit(train, held_out, self.config.fit)
        if config.method != "multiple_shooting" and report.held_out_error > 1e-4:
            self._tell_noise(train)
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

    def _finds_actuator(self, report: FitReport) -> bool:
        """Whether a fit shows that commands act late, and how; their path is then the task's."""
        assert self.data is not None
        if not self.lateness.suspected(self.loss, self.data, report.held_out_error):
            return False
        found = self.lateness.find(self.loss, self.data, self.generator, self._begin_again)
        if found is None:
            return False
        self._dropped += len(self.data) - len(found.data)
        self.data = found.data
        self._take_actuator(found.actuator)
        return True

    def _begin_again(self) -> None:
        self.dynamics.load_state_dict(self.initial)
        self.loss.lambda_.fill_(self.config.lambda_0)

    def _take_actuator(self, actuator: Actuator) -> None:
        """Go on with a task that has an actuator, in a world that shows what is under way."""
        self.lateness.open, self._found = False, actuator
        self.task = task = replace(self.task, actuator=actuator)
        self.world = copy.copy(self.world)  # not the user's own
        self.world.task = self.dynamics.task = self.exploration.task = task
        if self.env is not None:
            memory = Compose(*command_memory(task))
            self.env = TransformedEnv(self.env, memory, auto_unwrap=False)
        else:
            self.recorded = _recorded(self.world)

    def _tell_noise(self, data: TensorDict) -> None:
        """Warn, once, where sensor noise dominates the errors of single steps."""
        noisy = {n: c for n, c in successive_correlation(self.loss, data).items() if c < -0.3}
        if noisy and "noise" not in self._told:
            self._told.add("noise")
            _log.warning(
                "The errors of successive steps go against each other (correlation %s), as sensor "
                "noise makes them; it biases a fit of single steps. Take "
                "model.fit.method=multiple_shooting.",
                ", ".join(f"{value:.2f} in {name}" for name, value in noisy.items()),
            )

    def _fit(self, train: TensorDict, held_out: TensorDict, config: FitConfig) -> FitReport:
        """Fit; the first and the last time choose the integrator too, if the settings say so."""
        chooses = self.config.integrator == AUTO and config.method != "adam"
        if not chooses or not (self.iteration == 1 or self._has_all):
            return fit(self.loss, train, held_out, config, self.generator)
        report, trials = fit_solver(self.loss, train, held_out, config, self.generator)
        if len(trials) > 1:
            tried = ", ".join(str(trial) for trial in trials)
            solver = self.dynamics.integrator
            _log.info("The model is integrated by %s (held-out errors: %s).", solver, tried)
        return report

    def state_dict(self) -> dict[str, Any]:
        """Return the state that a resumed run needs, as tensors and numbers."""
        return {
            "dynamics": self.dynamics.state_dict(),
            "initial": self.initial,
            "loss": {name: buffer for name, buffer in self.loss.named_buffers(recurse=False)},
            "data": None if self.data is None else self.data.to_dict(),
            "solver": self._solver(),
            "actuator": None if self._found is None else self._found.config,
            "iteration": self.iteration,
            "new": self._new,
            "dropped": self._dropped,
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state_dict`."""
        if (actuator := state.get("actuator")) is not None:
            self._take_actuator(Actuator(**actuator))
        self.dynamics.load_state_dict(state["dynamics"])
        self.initial = dict(state["initial"])
        for name, value in state["loss"].items():
            self.loss.get_buffer(name).copy_(value)
        data = state["data"]
        self.data = None if data is None else TensorDict(data).auto_batch_size_(1)
        self.lateness.open &= data is None or "step_count" in data
        self.iteration = state["iteration"]
        if (solver := state.get("solver")) is not None:
            self.dynamics.integrator = SOLVERS[solver]
        self._new, self._dropped = state.get("new", 0), state.get("dropped", 0)
        self.generator.set_state(state["generator"])

    def _solver(self) -> int | None:
        """The number of the integrator among those that are tried, if it is to be chosen."""
        if self.config.integrator != AUTO:
            return None
        return next((i for i, s in enumerate(SOLVERS) if s is self.dynamics.integrator), None)

    def _draw_seed(self) -> int:
        return int(torch.randint(2**31, (), generator=self.generator))


def _recorded(world: World) -> TensorDict | None:
    """All transitions of a world that has recordings alone; ``None`` for other worlds."""
    if world.has_env:
        return None
    if world.recordings is None:
        raise ConfigError("world", f"{world} has neither an environment nor recordings.")
    data = transitions(world.task, world.recordings)
    # Equal time steps are the task's, for which a model is faster.
    if torch.allclose(data["time_step"], torch.tensor(world.task.time_step), rtol=_SAME_STEP):
        del data["time_step"]
    return data


def _build(context: Context) -> Phase:
    config = context.settings
    return ModelTrainer(context.task, config, seed=context.config.seed, world=context.world)


register_phase("model", ModelConfig, _build, unit="steps")
