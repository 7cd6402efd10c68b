"""References and inputs of a world that somebody else made, which knows nothing of references."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from tensordict.utils import expand_as_right
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs import EnvBase, Transform

from phihp_torchrl.config import ConfigError
from phihp_torchrl.tasks import Task


def signal_source(task: Task, env: EnvBase) -> list[Transform]:
    """The transforms that give ``env`` the signals of ``task``; none or one.

    Raises:
        ConfigError: for a task with inputs, in an environment that does not show them.
    """
    shown = env.observation_spec["observation"].shape[-1]
    if not task.outside or shown != task.system.observation_dim:
        return []
    if task.inputs is not None:
        found = env.observation_spec.get("inputs", None)
        sizes = [(task.inputs.size,), (task.inputs.rows, task.inputs.size)]
        if found is None or tuple(found.shape) not in sizes:
            got = "none" if found is None else f"shape {list(found.shape)}"
            raise ConfigError(
                "world",
                f"expected 'inputs' of shape {list(sizes[0])} ({', '.join(task.inputs.names)}), "
                f"got {got}.",
            )
    return [SignalSource(task)]


class SignalSource(Transform):
    """Append the signals of a task to the observations of an environment that does not show them.

    References are drawn anew for each episode by the task's sampler, from torch's global generator.
    Inputs are what the world measures, under the key ``"inputs"``. The reward of a world that knows
    no reference means nothing, so a task with a reference takes its own.

    Args:
        task: the task, with a reference or inputs.

    Examples:
        >>> from dataclasses import replace
        >>> from torchrl.envs import TransformedEnv
        >>> from phihp_torchrl import Signal, get_task
        >>> from phihp_torchrl.worlds import SimulatedWorld
        >>> task = get_task("pendulum")
        >>> aim = Signal(("theta",), low=(-1.0,), high=(1.0,), preview=2)
        >>> towards = lambda state, action, following, reference: -reference[..., 0].square()
        >>> follow = replace(task, reference=aim, reward=towards)
        >>> env = TransformedEnv(SimulatedWorld(task).make_env(), SignalSource(follow))
        >>> steps = env.rollout(5)["next"]
        >>> bool((steps["reward"] == -steps["observation"][:, 3:4].square()).all())
        True
    """

    def __init__(self, task: Task) -> None:
        super().__init__(in_keys=["observation"], out_keys=["observation"])
        self.task = task
        self._drawn: Mapping[str, Tensor] = {}
        self._age: Tensor | None = None

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        shown = tensordict_reset["observation"]
        if shown.shape[-1] != self.task.system.observation_dim:
            return tensordict_reset  # a row whose episode goes on
        mask = tensordict.get("_reset", None)
        drawn = self._draw(shown)
        fresh = torch.zeros(shown.shape[:-1], dtype=torch.long, device=shown.device)
        if mask is None or mask.all() or self._age is None:
            self._drawn, self._age = drawn, fresh
        else:
            mask = mask.reshape(shown.shape[:-1])
            self._age = torch.where(mask, fresh, self._age)
            self._drawn = {
                name: torch.where(mask[..., None, None], values, self._drawn[name])
                for name, values in drawn.items()
            }
        seen = self._complete(shown, tensordict_reset)
        if mask is not None and not mask.all():
            seen = torch.where(expand_as_right(mask, seen), seen, tensordict["observation"])
        return tensordict_reset.set("observation", seen)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        assert self._age is not None
        task = self.task
        expected = self._state(tensordict["observation"])
        self._age = self._age + 1
        seen = self._complete(next_tensordict["observation"], next_tensordict)
        if task.reference is not None:
            # A reference that was not known before the step is missed from the next one on.
            moved = task.split(self._state(seen))[0]
            registers = task.split(expected)[1]
            command = task.command(registers, tensordict["action"].to(registers))
            after = task.acting(registers, command)[1]
            earned = task.earned(expected, command, torch.cat([moved, after], -1))
            reward = next_tensordict["reward"]
            next_tensordict.set("reward", earned.reshape(reward.shape).to(reward.dtype))
        return next_tensordict.set("observation", seen)

    def _draw(self, shown: Tensor) -> dict[str, Tensor]:
        """Trajectories of what the world does not measure."""
        drawn = self.task.outside.draw(list(shown.shape[:-1]), self.task.max_steps + 1)
        return {name: v.to(shown) for name, v in drawn.items() if name != "inputs"}

    def _state(self, observation: Tensor) -> Tensor:
        """The state ``[*batch, n]`` of an observation with signals, with nothing else under way."""
        size = self.task.shown_dim
        rest = self.task.rest(observation)
        return self.task.locate(self.task.complete(observation[..., :size], rest))

    def _complete(self, shown: Tensor, measured: TensorDictBase) -> Tensor:
        outside, rest = self.task.outside, self.task.rest(shown)
        given = dict(self._now())
        if self.task.inputs is not None:
            given["inputs"] = measured["inputs"]
        own = outside.read(given, rest[..., : outside.size])
        complete = self.task.complete(shown, outside.replaced(rest, own))
        return complete[..., : self.task.shown_dim]

    def _now(self) -> Mapping[str, Tensor]:
        """The known values ``[*batch, rows, k]`` of each drawn signal, at each world's own age."""
        assert self._age is not None
        now = {}
        for name, values in self._drawn.items():
            signal = self.task.outside.signals[name]
            rows = self._age[..., None] + torch.arange(signal.rows, device=self._age.device)
            at = rows.clamp_max(values.shape[-2] - 1)[..., None]
            now[name] = values.gather(-2, at.expand(*at.shape[:-1], signal.size))
        return now

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        spec = observation_spec["observation"]
        shape = (*spec.shape[:-1], self.task.shown_dim)
        observation_spec["observation"] = Unbounded(shape, dtype=spec.dtype, device=spec.device)
        return observation_spec
