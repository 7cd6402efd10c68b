"""One-step and 20-step errors of a model, as a share of what "nothing changes" errs."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor

from phihp_torchrl.dynamics import DynamicsLoss

STEPS = (1, 20)


@torch.no_grad()
def shares(
    loss: DynamicsLoss, data: TensorDictBase, stops: Mapping[str, tuple[float, float]]
) -> dict[str, dict[str, dict[str, float]]]:
    """Errors by number of steps, by place (``overall``, ``away`` from stops) and by state.

    An error is the root mean square of predicted minus measured state, divided by that of the
    measured change over as many steps; ``all`` is the root mean square over the states.

    Args:
        loss: the loss of the model.
        data: transitions ``[N]`` in chronological order; ``done`` ends an episode.
        stops: lowest and highest position between the stops, by name.
    """
    names = loss.dynamics.task.system.state_names
    result = {}
    for steps in STEPS:
        error, change, away = _windows(loss, data, stops, steps)
        by_place = {}
        for place, mask in (("overall", torch.ones_like(away)), ("away", away)):
            if not mask.any():
                continue
            size = change[mask].square().mean(0).sqrt().clamp_min(1e-9)
            share = error[mask].square().mean(0).sqrt() / size
            row = dict(zip(names, share.tolist(), strict=True))
            row["all"] = share.square().mean().sqrt().item()
            row["windows"] = int(mask.sum())
            by_place[place] = row
        result[str(steps)] = by_place
    return result


def _windows(
    loss: DynamicsLoss,
    data: TensorDictBase,
    stops: Mapping[str, tuple[float, float]],
    steps: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """Error and change over each window ``[W, n]``, and whether it met no stop ``[W]``."""
    task = loss.dynamics.task
    state, action, next_state = loss.transitions(data)
    done = data["next", "done"].reshape(-1)
    starts = torch.arange(0, len(data) - steps + 1, max(1, steps // 4))
    index = starts[:, None] + torch.arange(steps)
    index = index[~done[index[:, :-1]].any(-1)]
    first, last = state[index[:, 0]], next_state[index[:, -1]]
    predicted = loss.dynamics.rollout(first, action[index])[:, -1]
    away = torch.ones(len(index), dtype=torch.bool)
    for name, (low, high) in stops.items():
        q = task.system.state_names.index(name)
        met = torch.cat([state[index][..., q], next_state[index][..., q]], -1)
        away &= ((met > low) & (met < high)).all(-1)
    return task.difference(last, predicted), task.difference(last, first), away
