"""An agent in a real loop: observation in, action out, with somebody who takes over."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import chain
from threading import RLock
from typing import Any

import torch
from numpy.typing import ArrayLike, NDArray
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from phihp_torchrl.config import ConfigError, is_whole, plain
from phihp_torchrl.deployment.control_report import ControlReport, Tally
from phihp_torchrl.deployment.deadline import DeadlineWorker
from phihp_torchrl.deployment.entries import Entries, as_numbers
from phihp_torchrl.deployment.estimation import find_model, needs_estimate
from phihp_torchrl.deployment.fallback import Fallback, FallbackChain
from phihp_torchrl.deployment.observer import VelocityObserver
from phihp_torchrl.deployment.own_check import OwnCheck
from phihp_torchrl.deployment.safety import Checks, Safety
from phihp_torchrl.deployment.under_way import COMPLETE, UnderWay
from phihp_torchrl.tasks import Task, find_task

_log = logging.getLogger(__name__)

Accept = Callable[[NDArray[Any], NDArray[Any]], bool]
"""Whether an action ``[m]`` may be sent for an observation ``[o]``."""


class Controller:
    """An agent in a real loop, with everything that it carries from step to step.

    :meth:`step` turns one measured observation into one action, and always returns an action that
    is finite, in bounds and within the limits of :class:`~phihp_torchrl.deployment.Safety`. Where
    the observation or the agent's action is not fit to be used, or the agent is late, another
    controller takes over for this step. Each such step is counted with its reason.

    The controller keeps what a task adds to the state: the commands that are under way, as they
    were sent and not as the agent wanted them, the reference, and the estimate of a disturbance. So
    an agent that was overruled still knows what acts. What is sent is within the task's own limit
    of the action's rate, whoever chose it.

    Args:
        agent: an :class:`~phihp_torchrl.Agent`, planning or not, compiled or not; an exported one
            (:func:`~phihp_torchrl.deployment.load_exported`); or any module that reads
            ``"observation"`` and writes ``"action"``.
        task: the task or its name. Defaults to the agent's.
        safety: the limits.
        fallback: who takes over, in this order: ``"actor"`` (the agent's, without a plan),
            ``"hold"`` (the last action, for a while), ``"zero"``, or a function of the observation
            ``[o]`` as it was measured that returns an action ``[m]``, or ``None`` to pass. The last
            resort is always rest. Defaults to the actor, if the agent plans and has one, and then
            to the last action.
        accept: a check of your own, of observation and action; false refuses the action, and so
            does an error that it raises, of which the first is logged.
        dynamics: the model, on the agent's device, by which a disturbance of the task is estimated.
            Defaults to the agent's, or to that of the baseline that it is or acts by; an exported
            agent has none. Observations that have the estimate in them need no model.
        observer: completes states whose velocities are not measured; :meth:`step` is then given
            physical states ``[n]`` with NaN for what is not measured.
        clock: a function that returns the time in seconds; timestamps are of this clock.

    Raises:
        ConfigError: for limits or a fallback that do not fit the agent and its task, and for an
            observer where a trained agent needs the estimate of a disturbance and has no model.

    Examples:
        >>> from phihp_torchrl import Agent, get_task
        >>> from phihp_torchrl.agents import Actor
        >>> task = get_task("pendulum")
        >>> controller = Controller(Agent(task, actor=Actor(task)), fallback="zero")
        >>> controller.step([1.0, 0.0, 0.0]).shape
        (1,)
        >>> controller.step([1.0, 0.0, float("nan")])  # a sensor that has failed
        array([0.], dtype=float32)
        >>> report = controller.report()
        >>> report.steps, dict(report.reasons)
        (2, {'observation': 1})
    """

    def __init__(
        self,
        agent: TensorDictModuleBase,
        task: str | Task | None = None,
        *,
        safety: Safety | None = None,
        fallback: Fallback | Sequence[Fallback] | None = None,
        accept: Accept | None = None,
        dynamics: nn.Module | None = None,
        observer: VelocityObserver | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        given = getattr(agent, "task", None) if task is None else task
        if given is None:
            raise ConfigError("task", "expected one, since the agent does not say its own.")
        self.agent, self.task = agent, find_task(given)
        self.safety = safety or Safety()
        self.observer = observer
        for key, function in (("accept", accept), ("clock", clock)):
            if not (callable(function) or (function is None and key == "accept")):
                raise ConfigError(key, f"expected a function, got {function!r}.")
        self._accept = None if accept is None else OwnCheck("accept", accept)
        self._clock = clock
        self._checks = Checks(self.task, self.safety)
        self._chain = FallbackChain(agent, self.task, self._checks, fallback)
        self._entries = Entries(agent, self.task)
        model, self._needs_estimate = None, False
        if self.task.disturbance is not None:
            model = find_model(agent) if dynamics is None else dynamics
            self._needs_estimate = model is None and needs_estimate(agent, self.task, observer)
        self._memory = UnderWay(self.task, model) if self.task.register_count else None
        self._worker = DeadlineWorker()
        self._lock = RLock()
        own = agent.parameters() if model is None else chain(agent.parameters(), model.parameters())
        like = next(own, torch.empty(0))
        self._like = torch.empty(0, dtype=torch.float32, device=like.device)
        self._cuda = [like.device] if like.is_cuda else []
        self._tally = Tally()
        self.reset()

    def reset(self) -> None:
        """Forget what is carried from step to step, at the start of an episode."""
        with self._lock:
            self._starts = True
            self._stamp: float | None = None
            self._last = self._checks.rest
            self._unheard = 0
            """Steps of which something was sent since the agent last began to act."""
            self._chain.reset()
            for part in (self._memory, self.observer):
                if part is not None:
                    part.reset()

    def step(
        self, observation: ArrayLike | Tensor, *, timestamp: float | None = None, **inputs: Any
    ) -> NDArray[Any]:
        """Return the action to send now, float32 ``[m]``, in physical units.

        Args:
            observation: what was measured, ``[o]``: the observation of the system alone, or with
                all that the task adds, which is then taken as it is, the estimate of a disturbance
                too; one of the two throughout an episode. For a controller with an observer, a
                state ``[n]``.
            timestamp: when it was measured, in seconds of ``clock``. With ``Safety.max_age`` it is
                stale where it is older, is NaN, or is more than a time step ahead; and always where
                it is that of the step before.
            inputs: further entries that the agent reads, by key: ``reference`` and ``inputs`` of
                the task, ``[k]``, or with their preview ``[rows, k]``, in physical units.

        Raises:
            ValueError: for an observation of the wrong size, as one without the estimate that a
                trained agent needs where there is no model; for a reference or inputs of the task
                that are missing where an episode starts, or of another shape; for an entry or, with
                ``Safety.max_age``, a timestamp that is no number; and for an entry that nobody
                reads.
        """
        with self._lock, torch.no_grad():
            started = self._clock()
            age = self._age(timestamp, started)
            finite = self._entries.read(inputs)
            lost = len(finite) < len(inputs)
            measured = as_numbers("observation", observation).detach().cpu()
            seen = self._complete(measured, finite.get("inputs"))
            reason = self._fault(seen, timestamp, age)
            shown = seen if reason is None else torch.full_like(seen, torch.nan)
            data = self._data(shown, finite, lost)
            usable = None if reason else data
            if reason is None and lost:
                reason = "inputs"
            action = None
            if reason is None:
                assert data is not None
                action, reason = self._ask(data, seen, started)
            if action is None or reason is not None:
                action, name = self._chain.act(measured, usable, self._last)
                self._tally.overruled(str(reason), name)
            else:
                self._tally.acted()
                self._chain.reset()
            self._sent(action)
            self._tally.took(1e3 * (self._clock() - started))
            return action.numpy().copy()

    def warm_up(self, calls: int = 20) -> dict[str, float]:
        """Act a few times on states of the task without a deadline, so that nothing is new later.

        What compiles, compiles now. A warning is logged if the agent alone takes longer than the
        deadline.

        Returns:
            Quantiles of the time of an action after the first, in milliseconds.

        Raises:
            ConfigError: for ``calls`` that are no whole number.
        """
        calls = plain(calls)
        if not is_whole(calls, 0):
            raise ConfigError("calls", f"expected a whole number >= 0, got {calls!r}.")
        with self._lock, torch.no_grad(), torch.random.fork_rng(devices=self._cuda):
            states = (self.task.coverage or self.task.reset).sample([calls + 1])
            times = []
            for seen in self.task.observe(self.task.at_rest(states)):
                start = self._clock()
                starts = torch.ones(1, dtype=torch.bool, device=self._like.device)
                data = TensorDict(observation=seen.to(self._like), is_init=starts)
                self._run_agent(data, None)
                times.append(1e3 * (self._clock() - start))
                self._chain.warm_up(data)
            self.reset()
        later = torch.tensor(times[1:] or times, dtype=torch.float64)
        found = {f"p{round(100 * q)}_ms": later.quantile(q).item() for q in (0.5, 0.99)}
        deadline = self.safety.deadline
        if deadline is not None and found["p99_ms"] > 1e3 * deadline:
            _log.warning(
                "An action takes %.1f ms (99th percentile), and the deadline is %.1f ms: the "
                "fallback will often act. Compile the plan, plan on a smaller budget, or act by "
                "the actor alone.",
                found["p99_ms"],
                1e3 * deadline,
            )
        return found

    @property
    def estimate(self) -> Tensor | None:
        """Our estimate ``[size]`` of the task's disturbance; ``None`` where we make none."""
        return None if self._memory is None else self._memory.estimate

    def report(self) -> ControlReport:
        """What has happened since the controller was made, or :meth:`clear_report`."""
        with self._lock:
            return self._tally.report()

    def clear_report(self) -> None:
        """Count from zero again."""
        with self._lock:
            self._tally = Tally()

    def close(self) -> None:
        """End the thread in which the agent acts; the controller can be used again."""
        self._worker.close()

    # One step, in its order.

    def _complete(self, measured: Tensor, inputs: Tensor | None) -> Tensor:
        """The observation ``[o]`` for what was measured."""
        system = self.task.system
        if self.observer is not None:
            sizes = {system.state_dim}
        else:
            sizes = {system.observation_dim, self.task.observation_dim}
        without = ""
        if self._needs_estimate:
            sizes = {self.task.observation_dim}
            without = ", with the estimate of the disturbance where there is no model (`dynamics`)"
        if measured.ndim != 1 or len(measured) not in sizes:
            raise ValueError(
                f"observation: expected shape [{' or '.join(map(str, sorted(sizes)))}]{without}, "
                f"got {list(measured.shape)}."
            )
        if self.observer is None:
            return measured
        return system.observe(self.observer.update(measured, inputs))

    def _age(self, timestamp: Any, now: float) -> float:
        """Seconds since a sample was measured; 0 where nobody asks."""
        if timestamp is None or self.safety.max_age is None:
            return 0.0
        try:
            if isinstance(seconds := plain(timestamp), (str, bytes, bool)):
                raise TypeError("expected a number")
            return now - float(seconds)
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"timestamp: expected seconds, got {timestamp!r}.") from error

    def _fault(self, seen: Tensor, timestamp: float | None, age: float) -> str | None:
        if timestamp is not None:
            last, self._stamp = self._stamp, timestamp
            limit = self.safety.max_age
            # NaN is not within any limits; by a step, two clocks may differ.
            fresh = limit is None or -self.task.time_step <= age <= limit
            if not fresh or timestamp == last:
                return "stale"
        return self._checks.observation(seen)

    def _data(self, seen: Tensor, finite: dict[str, Tensor], lost: bool) -> TensorDict | None:
        """What the agent is to read; ``None`` where a first reference or input is not finite.

        Later ones that are not finite, and so were lost, are left out: the last value is kept.
        """
        like, memory = self._like, self._memory
        entries = {key: value.to(like) for key, value in finite.items()}
        data = TensorDict(observation=seen.to(like), **entries)
        disturbed, size = self.task.disturbance is not None, self.task.observation_dim
        if disturbed and len(seen) == size:
            data.set(COMPLETE, torch.ones(1, dtype=torch.bool))  # by the caller
        if memory is not None and not memory.is_asked(data):
            memory = None
        self._remembers = memory is not None
        if lost and not (memory is not None and memory.has_begun):
            return None
        if memory is not None:
            data = memory.extend(data).set(COMPLETE, torch.ones(1, dtype=torch.bool))
        return data.set("is_init", torch.tensor([self._starts], device=like.device))

    def _ask(
        self, data: TensorDict, seen: Tensor, started: float
    ) -> tuple[Tensor | None, str | None]:
        """The agent's action and why it must not be used, one of which is ``None``."""
        deadline = self.safety.deadline
        left = None if deadline is None else max(0.0, deadline - (self._clock() - started))
        starts = self._starts
        try:
            action = self._run_agent(data, left)
        except TimeoutError:
            return None, "late"
        except Exception:
            _log.exception("The agent failed; the fallback acts.")
            self._starts, self._unheard = starts, 1  # it has not acted in this step
            return None, "error"
        if (reason := self._checks.action(action, self._last)) is not None:
            return None, reason
        action = self._checks.command(action, self._last)
        if self._checks.violates(seen, action):
            return None, "constraint"
        if self._accept is not None and not self._accept(seen.numpy(), action.numpy()):
            return None, "refused"
        return action, None

    def _run_agent(self, data: TensorDict, timeout: float | None) -> Tensor:
        waits = self.safety.deadline is not None
        if waits and timeout is not None and self._worker.busy:
            raise TimeoutError("an earlier call is still at work")
        act = partial(_act, self.agent, data.clone(), self._last.to(self._like), self._unheard)
        self._starts, self._unheard = False, 0  # for now it begins, in time or not
        return self._worker.run(act, timeout) if waits else act()

    def _sent(self, action: Tensor) -> None:
        self._last = action
        self._unheard += 1
        if self._memory is not None and self._remembers:
            try:
                self._memory.record(action.to(self._like))
            except Exception:
                _log.exception("The model failed; what is under way is as it was.")
        if self.observer is not None:
            self.observer.acted(action)


@torch.no_grad()
def _act(agent: TensorDictModuleBase, data: TensorDict, last: Tensor, unheard: int) -> Tensor:
    """The action, after the agent is told, in its own thread, what was sent since its last one."""
    if data["is_init"].item():
        if _has(agent, "reset"):
            agent.reset()
    elif unheard and _has(agent, "follow"):
        agent.follow(last, unheard - 1)
    return agent(data)["action"].detach().cpu()


def _has(agent: TensorDictModuleBase, name: str) -> bool:
    """Whether an agent has a method itself; a TensorDictModule has those of its network too."""
    return hasattr(type(agent), name)
