"""The gymnasium ids of the paper's worlds."""

from __future__ import annotations

import pytest

TASKS = {
    "phihp/Pendulum-v0": "pendulum",
    "phihp/PendulumSwingup-v0": "pendulum-swingup",
    "phihp/CartPole-v0": "cartpole",
    "phihp/CartPoleSwingup-v0": "cartpole-swingup",
    "phihp/CartPoleSwingupPublished-v0": "cartpole-swingup-published",
    "phihp/Acrobot-v0": "acrobot",
    "phihp/AcrobotSwingup-v0": "acrobot-swingup",
}
all_ids = pytest.mark.parametrize("env_id", list(TASKS))
