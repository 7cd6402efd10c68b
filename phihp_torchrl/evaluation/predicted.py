"""What a model predicts of an episode that was played, to hold it against what happened."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from phihp_torchrl.dynamics import HybridDynamics, TaskWorldModel
from phihp_torchrl.evaluation.episode import Episode

EVERY = 20
"""Steps of a prediction, as in the error that a fit reports."""


@dataclass(frozen=True)
class Predictions:
    """Predictions of the states of an episode from its actions alone, begun anew now and then.

    Args:
        states: the predicted state at the end of each step, ``[T, n]``; not finite where the model
            has left the finite numbers.
        every: steps of each prediction; it begins at the state of the episode.
    """

    states: NDArray[np.float64]
    every: int

    def pieces(self, episode: Episode, i: int) -> Iterator[tuple[slice, NDArray[np.float64]]]:
        """Places and values of component ``i`` of each prediction, with the state it began at."""
        for start in range(0, len(self.states), self.every):
            end = min(start + self.every, len(self.states))
            begun = episode.states[start : start + 1, i]
            yield slice(start, end + 1), np.concatenate([begun, self.states[start:end, i]])


@torch.no_grad()
def predict_episode(dynamics: HybridDynamics, episode: Episode, every: int = EVERY) -> Predictions:
    """Let a model predict an episode from its actions, begun anew at its states.

    Args:
        dynamics: the model.
        episode: the episode, of the model's task.
        every: steps of each prediction.

    Examples:
        >>> from phihp_torchrl import Agent, get_task
        >>> from phihp_torchrl.agents import Actor
        >>> from phihp_torchrl.evaluation import play_episode
        >>> from phihp_torchrl.worlds import SimulatedConfig, SimulatedWorld
        >>> task = get_task("pendulum")
        >>> episode = play_episode(Agent(task, actor=Actor(task)), task, max_steps=5)
        >>> exact = SimulatedWorld(task).oracle()
        >>> found = predict_episode(exact, episode, every=3)
        >>> bool(np.allclose(found.states, episode.states[1:], atol=1e-4))
        True
    """
    model = TaskWorldModel(dynamics.task, dynamics)
    like = next(iter([*dynamics.parameters(), *dynamics.buffers()]), torch.zeros(()))
    states = torch.from_numpy(episode.states).to(like)
    actions = torch.from_numpy(episode.actions).to(like)
    state, found = states[0], []
    for step, action in enumerate(actions):
        if step % every == 0:
            state = states[step]
        state = model.transition(state, action)[0]
        found.append(state)
    return Predictions(torch.stack(found).cpu().double().numpy(), every)
