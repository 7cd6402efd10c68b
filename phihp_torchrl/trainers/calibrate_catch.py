"""Whether a regulator may act near the goal in the place of plans, by imagined episodes."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import cached_property
from typing import Any

from phihp_torchrl.baselines import Catch, Settle, TakeOver
from phihp_torchrl.config import ConfigError
from phihp_torchrl.planners import RESTS
from phihp_torchrl.trainers.calibrate_contest import Contest
from phihp_torchrl.trainers.calibrate_rule import Choice, Way, costs_little, loses_nothing

_log = logging.getLogger(__name__)

# By name, shares of the level from which a regulator arrives; from far away it may take long.
_SHARES = {"caught": 1.0, "caught close": 0.1, "caught closer": 0.01, "caught closest": 0.001}


class CatchTrial:
    """Lets the plan that was chosen play once more with a regulator near the goal.

    It does so where the agent does not come to rest, or follows a reference. The regulators are
    one, which takes over from as far away as it arrives, or from a tenth, a hundredth or a
    thousandth of that cost-to-go (:class:`~phihp_torchrl.baselines.Catch`); on a reference, from
    near it where it stands still (:class:`~phihp_torchrl.baselines.Settle`). The first by which the
    agent loses nothing is kept; where the actor is to act, it belongs to the plan, which has to be
    smoother besides. On a reference, where there is none, it is the one that earns most of those
    that cost 1 % of the return at most: their steadiness is worth that.

    Args:
        contest: the episodes, of which the ways to plan have played.
    """

    def __init__(self, contest: Contest) -> None:
        self.contest = contest
        self.settled: tuple[Choice, int] | None = None
        """The choice without a regulator, and the episodes it rests on; ``None`` before it."""
        self.kept: str | None = None
        """The name of the regulator that is kept."""

    def begin(self, choice: Choice, *, doubted: bool = False) -> bool:
        """Settle a choice, and let the first regulator play; whether there is one to play.

        Args:
            choice: the way to plan, and who acts.
            doubted: whether other models disagree, so that a regulator of this one is not tried.
        """
        self.settled = choice, self.contest.episodes
        restless = self._follows or self.before.mean_chatter > RESTS
        return not doubted and restless and self._try_next()

    def judge(self) -> bool:
        """Compare what has played with the agent without it; whether there is more to play."""
        contest, before, (name,) = self.contest, self.before, self.contest.playing
        way, confidence = contest.way(name), contest.config.confidence
        calmer = self.choice.acting == "planner" or way.smoother_than(before)
        if calmer and loses_nothing(way, before, confidence=confidence):
            self.kept = name
            return False
        if self._try_next():
            return True
        if self._follows:  # imagination knows every load, and a regulator is for those unknown
            ways = {each: contest.way(each) for each in _SHARES if contest.has_played(each)}
            cheap = (each for each in ways if costs_little(ways[each], before, steadier=True))
            self.kept = max(cheap, key=lambda each: ways[each].mean_return, default=None)
        return False

    @property
    def _follows(self) -> bool:
        return self.contest.agent.task.reference is not None

    @property
    def choice(self) -> Choice:
        """The choice; a regulator that is kept belongs to plans."""
        assert self.settled is not None
        choice = self.settled[0]
        return choice if self.kept is None else choice._replace(acting="planner")

    @property
    def episodes(self) -> int:
        """The episodes that the choice rests on."""
        assert self.settled is not None
        return self.settled[1]

    @property
    def before(self) -> Way:
        """What the agent earns without a regulator."""
        assert self.settled is not None
        choice, episodes = self.settled
        if choice.acting == "planner":
            return self.contest.way(choice.name)
        return self.contest.actor(episodes)

    def record(self) -> dict[str, Any] | None:
        """What was found of the regulator that is kept, in plain values."""
        if self.kept is None:
            return None
        way, before = self.contest.way(self.kept), self.before
        gain, error = way.ahead_of(before)
        return {
            "way": self.kept,
            "share": _SHARES[self.kept],
            "gain": gain,
            "gain_error": error,
            "chatter": way.mean_chatter,
            "chatter_before": before.mean_chatter,
        }

    def made(self, record: Mapping[str, Any] | None) -> TakeOver | None:
        """The regulator of a record."""
        return None if record is None else self._catch(record["way"])

    def state_dict(self) -> dict[str, Any]:
        """Everything that a resumed run needs; regulators are made again."""
        settled = None if self.settled is None else (tuple(self.settled[0]), self.settled[1])
        return {"settled": settled, "kept": self.kept}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state_dict`, after the contest has."""
        settled, self.kept = state["settled"], state["kept"]
        self.settled = None if settled is None else (Choice(*settled[0]), settled[1])
        for name in self.contest.ways:
            if name in _SHARES and (catch := self._catch(name)) is not None:
                self.contest.catches[name] = catch

    def _try_next(self) -> bool:
        """Let the next regulator play, in some of the episodes; whether there is one."""
        contest = self.contest
        name = next((name for name in _SHARES if name not in contest.ways), None)
        catch = None if name is None or not contest.config.catch else self._catch(name)
        if name is None or catch is None:
            return False
        contest.episodes = min(self.episodes, 2 * contest.config.episodes)
        contest.add(name, contest.ways[self.choice.name], catch)
        return True

    @cached_property
    def _widest(self) -> TakeOver | None:
        """The regulator that takes over from furthest, at the goal or on a reference, if any."""
        agent = self.contest.agent
        assert agent.dynamics is not None
        sort: type[TakeOver] = Catch if agent.task.reference is None else Settle
        try:
            made = sort.from_model(agent.task, agent.dynamics)
        except ConfigError:  # there is no goal to stay in
            return None
        except Exception as error:  # of a task's own functions, in double precision or for slopes
            _log.warning(
                "No regulator is tried near the goal, for none could be made: %s: %s. "
                "calibrate.catch=false says so beforehand.",
                type(error).__name__,
                error,
            )
            return None
        return made.to(self.contest.starts.device)

    def _catch(self, name: str) -> TakeOver | None:
        return None if self._widest is None else self._widest.closer(_SHARES[name])
