"""The published results (paper, main table), and this package's targets."""

from __future__ import annotations

from types import MappingProxyType
from typing import NamedTuple


class Published(NamedTuple):
    """A published result: mean ± std over 10 runs.

    Attributes:
        return_mean: mean return.
        return_std: standard deviation of the return.
        samples: real samples, in thousands; ``None`` for an oracle, which has the true model.
        milliseconds: time of an action, on an Apple M1.
    """

    return_mean: float
    return_std: float
    samples: float | None
    milliseconds: float


PUBLISHED = MappingProxyType(
    {
        "pendulum": {
            "PhIHP": Published(-263, 144, 2, 6.32),
            "TD-MPC": Published(-276, 301, 26, 39.6),
            "TD3": Published(-229, 155, 86, 0.11),
            "CEM-oracle": Published(-228, 71, None, 18.9),
        },
        "pendulum-swingup": {
            "PhIHP": Published(-356, 13, 5, 6.37),
            "TD-MPC": Published(-395, 324, 28, 39.6),
            "TD3": Published(-368, 14, 57, 0.11),
            "CEM-oracle": Published(-597, 6, None, 18.9),
        },
        "cartpole": {
            "PhIHP": Published(500, 0, 5, 7.43),
            "TD-MPC": Published(432, 129, 23, 39.3),
            "TD3": Published(464, 80, 108, 0.11),
            "CEM-oracle": Published(453, 24, None, 33.2),
        },
        "cartpole-swingup-published": {
            "PhIHP": Published(453, 8, 5, 10.1),
            "TD-MPC": Published(460, 4, 76, 39.4),
            "TD3": Published(354, 113, 27, 0.11),
            "CEM-oracle": Published(446, 5, None, 33.7),
        },
        "acrobot": {
            "PhIHP": Published(-138, 122, 5, 11.1),
            "TD-MPC": Published(-249, 168, 10, 39.4),
            "TD3": Published(-237, 183, 233, 0.12),
            "CEM-oracle": Published(-500, 0, None, 59.8),
        },
        "acrobot-swingup": {
            "PhIHP": Published(371, 52, 15, 9.12),
            "TD-MPC": Published(373, 127, 135, 39.4),
            "TD3": Published(119, 71, 500, 0.12),
            "CEM-oracle": Published(349, 5, None, 58.5),
        },
    }
)
"""The published results, by task and method.

The paper's CartPoleSwingup is ``cartpole-swingup-published``: its reward is another than that of
``cartpole-swingup``, which has no published number. CEM-oracle's 349 on AcrobotSwingup could not be
reproduced.
"""

TARGETS = MappingProxyType(
    {
        "pendulum": -220.0,
        "pendulum-swingup": -356.0,
        "cartpole": 500.0,
        "cartpole-swingup": 420.0,
        "acrobot": -100.0,
        "acrobot-swingup": 390.0,
    }
)
"""The mean return that this package's planner should reach, by task; not from the paper."""
