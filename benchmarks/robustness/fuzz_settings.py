"""Hostile values in every setting of a run: refused by name, or the run can be made.

    python benchmarks/robustness/fuzz_settings.py                     # 4,000 settings, 40 runs
    python benchmarks/robustness/fuzz_settings.py --settings 200 --runs 4

Settings are read as a run reads them, and checked against the task and the world as it does before
its first real step. Any other error than a ``ConfigError`` counts as a traceback, and more than a
minute as a hang. Of those that are accepted some are run whole, in small. Writes
results/robustness/fuzz_settings.json.
"""

from __future__ import annotations

import argparse
import math
import os
import random
import signal
import tempfile
from collections import Counter
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from found import write_part
from phihp_torchrl import ConfigError, load_config, make_world
from phihp_torchrl.config import flatten
from phihp_torchrl.trainers import (
    NonFiniteError,
    RunConfig,
    check_run,
    read_run_config,
    run,
    task_of,
)
from small_run import TASK, TINY, prepare

HOSTILE: tuple[Any, ...] = (
    *(math.nan, math.inf, -math.inf, -1, -0.5, 0, 0.0, 1, 2, 3.5, 1e-300, 1e39, 1e300),
    *(10**9, 10**18, -(10**9), "x", "", "1 s", "-1 s", "1e999 s", "auto", "none"),
    *(None, True, False, [], [0], [math.nan], [-1, 2], ["x"], {}, {"x": 1.0}, {"x": math.nan}),
)
METHODS = ("phihp", "ph-cem", "td3", "td-mpc")
LIMIT = 60
"""Seconds that reading and checking, or a small run, may take."""
_APART = ("run_dir", "resume", "trust", "plugins", "threads", "logger", "progress", "compile")
"""Settings that a run in small does not try: of where and how, or of other processes."""


class Slow(Exception):
    """Something takes longer than the limit."""


def main() -> None:
    """Try hostile settings, and small runs of some that are accepted."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--settings", type=int, default=4000)
    parser.add_argument("--runs", type=int, default=40)
    options = parser.parse_args()
    prepare()
    signal.signal(signal.SIGALRM, _too_slow)
    draw = random.Random(0)
    small = {"phihp": TINY}
    bases = {
        name: load_config(TASK, method=name, overrides=small.get(name, {})) for name in METHODS
    }
    counts: Counter[str] = Counter()
    ended: Counter[str] = Counter()
    tracebacks, keys = [], set()
    for number in range(1, options.settings + 1):
        method = draw.choice(METHODS)
        key, value = draw.choice(sorted(flatten(bases[method]))), draw.choice(HOSTILE)
        keys.add(key)
        settings = changed(bases[method], key, value)
        found, told = _try(partial(read, settings))
        counts[found] += 1
        if found == "traceback":
            tracebacks.append(f"{method} {key}={value!r}: {told}"[:300])
        wanted = method in small and key.split(".")[0] not in _APART
        if found == "accepted" and wanted and sum(ended.values()) < options.runs:
            end = run_apart(settings)
            ended[end] += 1
            if end.startswith(("traceback", "hang")):
                tracebacks.append(f"run of {method} {key}={value!r}: {end}")
        if number % 100 == 0 or number == options.settings:
            record = {
                "settings": number,
                "methods": list(METHODS),
                "keys": len(keys),
                "refused": counts["refused"],
                "accepted": counts["accepted"],
                "hangs": counts["hang"],
                "tracebacks": tracebacks,
                "limit_seconds": LIMIT,
                "runs": sum(ended.values()),
                "runs_ended": dict(ended),
            }
            write_part("fuzz_settings", record)
    print(record)


def changed(settings: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    """The settings with another value of a dotted key."""
    head, _, rest = key.partition(".")
    inner = settings.get(head)
    if not rest or not isinstance(inner, dict):
        return {**settings, head: value}
    return {**settings, head: changed(inner, rest, value)}


def read(settings: dict[str, Any]) -> RunConfig:
    """Read and check settings as a run does before its first real step."""
    config = read_run_config(settings)
    check_run(config, make_world(task_of(config), config.world))
    return config


def run_apart(settings: dict[str, Any]) -> str:
    """Make a whole run in a forked process; how it ended."""
    with tempfile.TemporaryDirectory() as place:
        reading, writing = os.pipe()
        pid = os.fork()
        if pid == 0:
            with suppress(BaseException):
                found, told = _try(lambda: run(read(settings), Path(place) / "run"))
                os.write(writing, f"{found} {told}"[:200].encode())
            os._exit(0)
        os.close(writing)
        with os.fdopen(reading, encoding="utf-8", errors="replace") as file:
            text = file.read()
        os.waitpid(pid, 0)
    return text.replace("accepted", "finished").strip() or "traceback: the process died"


def _try(work: Any) -> tuple[str, str]:
    """How a piece of work ends: accepted, refused, hang or traceback; and what is said then."""
    signal.alarm(LIMIT)
    try:
        work()
    except (ConfigError, NonFiniteError):
        return "refused", ""
    except Slow:
        return "hang", ""
    except Exception as error:
        return "traceback", f"{type(error).__name__}: {error}"
    finally:
        signal.alarm(0)
    return "accepted", ""


def _too_slow(*_: object) -> None:
    raise Slow


if __name__ == "__main__":
    main()
