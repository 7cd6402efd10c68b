"""Where phase 1 has its real transitions from: an environment, or recordings."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import Compose, EnvBase, TransformedEnv

from phihp_torchrl.config import ConfigError
from phihp_torchrl.imagination import Batch
from phihp_torchrl.recordings import transitions
from phihp_torchrl.tasks import Task
from phihp_torchrl.trainers.collect import Policy, drop_unusable, steady, within_rate
from phihp_torchrl.worlds import World, check_env, command_memory, crossings_text, guard_env

DOING = "taking real steps"
"""What a run says that it is doing while this is on its stack."""

_log = logging.getLogger(__name__)

_SAME_STEP = 1e-3
"""Recorded time steps within this share of the task's are the task's."""


class Taken(NamedTuple):
    """Real steps that were taken.

    Args:
        data: the transitions of which no number is missing, ``[N]``.
        dropped: how many others there were.
        missing: how many steps were not taken, because the environment failed.
        failure: the error to raise, once the data are safe; ``None`` for none.
    """

    data: TensorDict
    dropped: int
    missing: int
    failure: ConfigError | None


class RealData:
    """The source of real transitions: the environment of a world, or all of its recordings.

    Args:
        task: the task.
        world: the real world.
        guards: by name of what a guard watches, its largest size, or lowest and highest value.
    """

    def __init__(
        self, task: Task, world: World, guards: Mapping[str, float | tuple[float, float]]
    ) -> None:
        self.task = task
        self.crossings: Counter[str] = Counter()
        """How often each guard ended an episode of the last steps."""
        self.env: EnvBase | None = None
        if world.has_env:
            env = world.make_env()
            check_env(task, env)
            self.env = guard_env(env, task, guards, self.crossings)
        self.recorded = _recorded(world)
        """All transitions of a world that has recordings alone; ``None`` for other worlds."""

    def use(self, task: Task, world: World) -> None:
        """Go on with a task that has got an actuator, and show what is under way."""
        self.task = task
        if self.env is not None:
            memory = Compose(*command_memory(task))
            self.env = TransformedEnv(self.env, memory, auto_unwrap=False)
        else:
            self.recorded = _recorded(world)

    def take(self, steps: int, policy: Policy, seed: int, *, counts: bool = False) -> Taken:
        """Take real steps; those before a failure of the environment are returned too.

        Args:
            steps: how many.
            policy: what acts.
            seed: seed of the environment, for the states in which episodes start.
            counts: whether to keep the number of each step in its episode.

        Raises:
            ConfigError: if the environment fails before the first step is done.
        """
        assert self.env is not None
        self.env.set_seed(seed)
        self.crossings.clear()
        rollout, failure = self._rollout(steps, within_rate(self.task, steady(self.task, policy)))
        missing, steps = steps - len(rollout), len(rollout)
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
        if counts:
            data["step_count"] = rollout["step_count"]
        data, dropped, refusal = drop_unusable(data)
        return Taken(data, dropped, missing, failure or refusal)

    def _rollout(self, steps: int, policy: Policy) -> tuple[TensorDictBase, ConfigError | None]:
        """Real steps, and the error that ended them early."""
        assert self.env is not None
        done: list[TensorDictBase] = []
        try:
            with torch.no_grad():
                return self.env.rollout(
                    steps,
                    policy,
                    break_when_any_done=False,
                    callback=lambda _, step: done.append(step.clone()),
                ), None
        except ConfigError as error:  # of a guard or a controller, which says enough
            failure = error
        # Somebody else's environment may raise anything, and its steps were dear.
        except Exception as error:
            failure = ConfigError(
                "world",
                f"its environment failed at step {len(done)} of {steps}: "
                f"{type(error).__name__}: {error} The {len(done)} steps before it are kept, and a "
                "resumed run goes on with them.",
            )
            failure.__cause__ = error
        if not done:
            raise failure
        return torch.stack(done), failure

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


def replay_batch(task: Task, data: TensorDict | None) -> Batch:
    """Real transitions ``[N]`` as replay keeps them: with rewards less prices.

    Args:
        task: the task.
        data: the transitions; ``None`` for none.
    """
    if data is None:
        state, action = torch.zeros(0, task.state_dim), torch.zeros(0, task.action_dim)
        return Batch(state, action, torch.zeros(0), state, torch.zeros(0, dtype=torch.bool))
    state = task.locate(data["observation"])
    next_state = task.locate(data["next", "observation"])
    action = data["action"]
    # "done" in the data includes truncations, which are not terminations.
    command = task.command(task.split(state)[1], action)
    terminated = task.is_terminated(next_state, command)
    reward, price = data["next", "reward"][:, 0], task.price(state, action, next_state)
    reward = reward if price is None else reward - price
    return Batch(state, action, reward, next_state, terminated)


def collected_return(task: Task, data: TensorDict) -> float:
    """The return of an episode as the real steps of a collection were taken.

    Where episodes were terminated, it is the mean return of those that are over. Where none was, it
    is the mean reward times the steps of an episode, for a collection may be shorter than one.

    Args:
        task: the task.
        data: transitions ``[N]`` in order; the last one is ``"done"`` in any case.
    """
    reward, following = data["next", "reward"].flatten(), data["next"]
    if not following["terminated"].any():
        return reward.mean().item() * task.max_steps
    done = following["done"].flatten().clone()
    done[-1] = following["terminated"].flatten()[-1]
    ends = done.nonzero().flatten()
    return reward.cumsum(0)[ends[-1]].item() / len(ends)


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
