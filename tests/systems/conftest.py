"""A cache of derived equations that the tests of this folder share and nobody else sees."""

from __future__ import annotations

import pytest

from phihp_torchrl.systems.derivation import CACHE_VARIABLE


@pytest.fixture(autouse=True, scope="session")
def _own_cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(CACHE_VARIABLE, str(tmp_path_factory.mktemp("cache")))
        yield
