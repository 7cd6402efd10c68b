"""Phase 2 with strategies: another one is tried where imagined returns stay at the floor."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor

from phihp_torchrl.agents import Scales, copy_actor, copy_twin_qvalue
from phihp_torchrl.config import resolve_seconds
from phihp_torchrl.tasks import Task
from phihp_torchrl.trainers.floor import Floor
from phihp_torchrl.trainers.policy import PolicyTrainer
from phihp_torchrl.trainers.policy_config import PolicyConfig
from phihp_torchrl.trainers.strategies import AS_SET, STRATEGIES, strategies_of

_log = logging.getLogger(__name__)

# A way to learn is left half-way if nearly all starts, of episodes and of lives, are at the
# floor, for returns may still rise late; at its end unless nearly all of episodes have left it.
_HALF_WAY, _AT_END = 0.9, 0.15


class _Found(NamedTuple):
    """The best actor of a way to learn, with its critics, in units of training."""

    name: str
    score: float
    imagined: float
    gamma: float
    layers: list[Tensor]
    actor_layers: int
    scales: Scales


class PolicySearch:
    """Trains by the settings as they are, and by strategies while returns stay at the floor.

    At half of the updates of a way to learn, and at their end, the best actor so far plays in the
    model from starts that are the same for all ways. If it earns no more than an unskilled policy
    (:class:`~phihp_torchrl.trainers.floor.Floor`) from 90 % of the starts half-way, or from more
    than 15 % of them at the end, a warning says so, and the next strategy begins anew, with as many
    updates. Half-way this must be so from the starts of imagined lives too: some of them lie near a
    sparse reward, from which skill spreads. The actor that earns most over all ways is kept.

    Args:
        task: the task.
        config: settings of phase 2.
        make: makes a trainer from settings.
        seed: seed of starts and of the unskilled policy.

    Raises:
        ConfigError: for a strategy of unknown name.

    Examples:
        >>> from dataclasses import replace
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> from phihp_torchrl.agents import RefitConfig
        >>> task = replace(get_task("pendulum"), max_steps=5)
        >>> model = HybridDynamics.hybrid(task)
        >>> config = PolicyConfig(updates=4, evaluation_interval=2, refit=RefitConfig(interval=0))
        >>> search = PolicySearch(
        ...     task, config, lambda settings: PolicyTrainer(task, model, settings, seed=0), seed=0
        ... )
        >>> metrics = search.advance()
        >>> sorted(search.parts())
        ['actor', 'qvalue']
    """

    def __init__(
        self,
        task: Task,
        config: PolicyConfig,
        make: Callable[[PolicyConfig], PolicyTrainer],
        *,
        seed: int,
    ) -> None:
        self.task = task
        self.config = resolve_seconds(config, task.time_step)
        self.ways = [(AS_SET, self.config), *self._changed()]
        self.make = make
        self.seed = seed
        self.tried = 0  # ways that are over
        self.spent = 0  # updates of them
        self.best: _Found | None = None
        self.trainer = make(self.config)
        self.over = False
        self.stuck = False
        generator = torch.Generator().manual_seed(seed)
        self._states = task.sample_start([config.evaluation_episodes], generator)
        self._floor: Floor | None = None
        self._checked_half = False

    @property
    def way(self) -> str:
        """Name of the present way to learn."""
        return self.ways[self.tried][0]

    @property
    def progress(self) -> tuple[int, int]:
        """Critic updates so far, and in all by the ways that have begun."""
        done, total = self.trainer.progress
        return self.spent + done, self.spent + total

    @property
    def done(self) -> bool:
        """Whether a way has come to its end, and no other is to be tried."""
        return self.over

    def advance(self) -> dict[str, float]:
        """Train for one evaluation interval; returns what to log."""
        if self.trainer.done:  # a budget of no updates or no seconds
            self.over = True
            return {}
        metrics = self.trainer.advance()
        metrics["policy/updates"] = float(self.spent + self.trainer.progress[0])
        metrics["policy/strategy"] = float(self.tried)
        at_end = self.trainer.done
        done, total = self.trainer.progress
        half = not self._checked_half and 2 * done >= total
        if at_end or (half and len(self.ways) > 1):
            self._checked_half = True
            metrics |= self._check(at_end)
        if self.over:  # not what the last way had found
            metrics["policy/best_imagined_return"] = self._kept().imagined
        return metrics

    def parts(self) -> dict[str, Any]:
        """Actor and critics, as arguments of :class:`~phihp_torchrl.deployment.Agent`."""
        return {"actor": self.best_actor(), "qvalue": self.best_qvalue()}

    def best_actor(self) -> TensorDictModule:
        """The actor that earned most in the model so far."""
        found = self._kept()
        layers = found.layers[: found.actor_layers]
        return copy_actor(self.task, found.scales.actor(layers))

    def best_qvalue(self) -> TensorDictModule:
        """The twin critics that belong to that actor."""
        found = self._kept()
        layers = found.layers[found.actor_layers :]
        return copy_twin_qvalue(self.task, found.scales.critics(layers))

    @property
    def planner_changes(self) -> dict[str, float]:
        """Settings for the planner: the discount of the kept critics."""
        return {"gamma": self._kept().gamma}

    @property
    def summary(self) -> dict[str, Any]:
        """What was tried and what worked, for the record of a run."""
        names = [name for name, _ in self.ways[: self.tried + 1]]
        return {"tried": names, "kept": self._kept().name, "at_floor": self.stuck}

    def trained(self) -> dict[str, Tensor]:
        """The layers that the present way trains, by name."""
        return self.trainer.trained()

    def state_dict(self) -> dict[str, Any]:
        """Everything that a resumed run needs, tensors and numbers only."""
        best = self.best
        return {
            **self.trainer.state_dict(),
            "search": {
                "tried": self.tried,
                "spent": self.spent,
                "over": self.over,
                "stuck": self.stuck,
                "checked_half": self._checked_half,
                "best": None
                if best is None
                else {
                    "name": best.name,
                    "score": best.score,
                    "imagined": best.imagined,
                    "gamma": best.gamma,
                    "layers": list(best.layers),
                    "actor_layers": best.actor_layers,
                    "scales": vars(best.scales).copy(),
                },
            },
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state_dict`; one of a single trainer is that of its end or midst.

        Raises:
            ConfigError: as :class:`~phihp_torchrl.trainers.PolicyTrainer`.
        """
        search = state.get("search")
        if search is not None:
            best = search["best"]
            self.tried, self.spent = search["tried"], search["spent"]
            self.over, self.stuck = search["over"], search["stuck"]
            self._checked_half = search["checked_half"]
            if best is not None:  # older checkpoints do not say what was logged
                scales = Scales(**best["scales"])
                self.best = _Found(**{"imagined": best["score"], **best, "scales": scales})
            if self.tried:
                self.trainer = self.make(self.ways[self.tried][1])
        self.trainer.load_state_dict(state)
        if search is None:
            self.over = self.trainer.done

    def _changed(self) -> list[tuple[str, PolicyConfig]]:
        """The strategies that change something, with their settings."""
        tried, ways = [self.config], []
        for name in strategies_of(self.config):
            changed = STRATEGIES[name].change(self.config, self.task)
            if changed not in tried:
                tried.append(changed)
                ways.append((name, changed))
        return ways

    @torch.no_grad()
    def _check(self, at_end: bool) -> dict[str, float]:
        """Look whether the best actor has left the floor, and go on to the next way if not."""
        trainer, steps = self.trainer, self.config.evaluation_steps or self.task.max_steps
        if self._floor is None:
            self._floor = trainer.floor(self._states, steps, self.seed)
            self._unit = trainer.scales.reward
        returns = self._returns(self._states, steps)
        returns = returns * (trainer.scales.reward / self._unit)  # the floor's unit
        share = self._floor.share(returns)
        score = float(torch.where(returns.isfinite(), returns, -math.inf).mean()) * self._unit
        if at_end:
            stuck = share > _AT_END
        else:
            stuck = share >= _HALF_WAY and self._share_of_lives(steps) >= _HALF_WAY
        if at_end or stuck:
            if self.best is None or score >= self.best.score:
                trainer.finish()
                self.best = self._present(score)
                self.stuck = share > _AT_END
            self._end(stuck, share, score)
        return {"policy/at_floor": share}

    def _share_of_lives(self, steps: int) -> float:
        """The share of starts of imagined lives from which the present way is at the floor."""
        generator, trainer = torch.Generator().manual_seed(self.seed), self.trainer
        lives = trainer.start_states.sample([len(self._states)], generator)
        floor = trainer.floor(lives, steps, self.seed)
        return floor.share(self._returns(lives, steps))

    def _returns(self, states: Tensor, steps: int) -> Tensor:
        """What the best actor of the present way earns in the model, in its own units."""
        trainer = self.trainer
        actor = trainer.best[: len(trainer.update.actor)]
        return trainer.rollouts.returns(actor, states, steps).total

    def _end(self, stuck: bool, share: float, score: float) -> None:
        """End the present way: begin the next one if it or the best is stuck, or say what worked.

        A way may leave the floor from most starts, and earn less than one that does not.
        """
        name, after = self.way, self.tried + 1
        limit = self.config.max_seconds
        out_of_time = limit is not None and self.trainer.seconds > limit
        if (stuck or self.stuck) and after < len(self.ways) and not out_of_time:
            text = "Imagined returns stay at the floor with strategy %r after %d updates"
            if not stuck:
                text = "Strategy %r earns less after %d updates than one that is at the floor"
            _log.warning(
                f"{text}: from %.0f %% of the starts the actor earns no more than by doing nothing "
                "or anything (mean %.4g). Trying strategy %r, which %s.",
                name,
                self.trainer.progress[0],
                100 * share,
                score,
                self.ways[after][0],
                STRATEGIES[self.ways[after][0]].about,
            )
            self.spent += self.trainer.progress[0]
            self.tried = after
            self._checked_half = False
            self.trainer = self.make(self.ways[after][1])
            return
        self.over = True
        if self.stuck:
            _log.warning(
                "Imagined returns stayed at the floor from many starts with the best of %s. Check "
                "that the reward can be reached: give the task a coverage box that holds the way "
                "to it and a goal box around it, or a reward that grows on the way.",
                [name for name, _ in self.ways[: self.tried + 1]],
            )
        elif self.tried:
            _log.warning(
                "Strategy %r worked: its actor has an imagined return of %.4g and is kept.",
                self._kept().name,
                self._kept().score,
            )

    def _present(self, score: float) -> _Found:
        """The best actor of the present way."""
        trainer = self.trainer
        layers = [layer.clone() for layer in trainer.best]
        gamma = trainer.config.td3.gamma
        return _Found(
            self.way, score, trainer.best_return, gamma, layers, len(trainer.update.actor),
            trainer.scales,
        )  # fmt: skip

    def _kept(self) -> _Found:
        return self.best if self.over and self.best is not None else self._present(-math.inf)
