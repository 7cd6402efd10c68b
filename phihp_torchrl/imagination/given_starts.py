"""Environments that start from a state in the tensordict of a reset, without being asked twice."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase


class GivenStarts:
    """A base of environments whose ``reset(tensordict)`` starts from the state given there.

    ``set_state=False`` and a ``"_reset"`` mask ask for fresh states. A mask selects rows whose
    episode has ended, so their state in the tensordict is an old one.
    """

    _supports_set_state = True

    def _input_td_has_state(self, tensordict: TensorDictBase | None) -> bool:
        if tensordict is None or "_reset" in tensordict:
            return False
        return super()._input_td_has_state(tensordict)  # type: ignore[misc]  # an EnvBase has it

    def _resolve_set_state(
        self, set_state: bool | None, tensordict: TensorDictBase | None, select_reset_only: bool
    ) -> bool | None:
        # A state in the tensordict is used without set_state=True, as in the stock classes.
        if set_state is None and not select_reset_only:
            set_state = self._input_td_has_state(tensordict)
        resolve: Any = super()._resolve_set_state  # type: ignore[misc]
        return resolve(set_state, tensordict, select_reset_only)
