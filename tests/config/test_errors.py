"""The one error of a setting."""

from __future__ import annotations

import pickle

import pytest

from phihp_torchrl import ConfigError as PublicError
from phihp_torchrl.config import ConfigError

ERROR = ConfigError("gamma", "expected a number in (0, 1], got 2.")


def test_it_is_a_value_error_with_its_key_and_reason_apart():
    assert PublicError is ConfigError
    assert isinstance(ERROR, ValueError)
    assert (ERROR.key, ERROR.reason) == ("gamma", "expected a number in (0, 1], got 2.")
    assert str(ERROR) == "gamma: expected a number in (0, 1], got 2."


@pytest.mark.parametrize(
    ("path", "key"), [("", "gamma"), ("td3", "td3.gamma"), ("policy.td3", "policy.td3.gamma")]
)
def test_inside_a_section_its_key_is_longer(path, key):
    inner = ERROR.inside(path)
    assert (inner.key, inner.reason) == (key, ERROR.reason)
    assert ERROR.key == "gamma"


def test_it_survives_the_way_between_processes():
    copy = pickle.loads(pickle.dumps(ERROR))
    assert (type(copy), copy.key, copy.reason) == (ConfigError, ERROR.key, ERROR.reason)
