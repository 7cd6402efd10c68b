"""Lines of a run: there in time, also while one unit of work goes on, and honest about the rest."""

from __future__ import annotations

import io
import threading
import time

import pytest

from phihp_torchrl.display import Progress, activity, loading
from phihp_torchrl.display.forecast import Forecast


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def lines(stream: io.StringIO) -> list[str]:
    return stream.getvalue().splitlines()


def test_lines_come_while_a_unit_of_work_goes_on() -> None:
    out = io.StringIO()
    with Progress({"fit": None}, stream=out, interval=0.1) as progress:
        progress.begin("fit", (0, 4), "parts")
        time.sleep(0.5)  # the run says nothing
        begun = len(lines(out))
        progress.advance((1, 4), "error 0.5", seconds=0.5)
        time.sleep(0.3)
    assert begun >= 3
    assert lines(out)[1].startswith("fit: 0 of 4 parts")
    assert "time left not known yet" in lines(out)[1]
    assert "fit: 1 of 4 parts" in lines(out)[-1]
    assert "about 1 s left, error 0.5" in lines(out)[-1]
    after = len(lines(out))
    time.sleep(0.3)
    assert len(lines(out)) == after  # nothing comes after the end


def test_a_log_has_no_control_characters_and_a_terminal_has_one_line() -> None:
    log, terminal = io.StringIO(), Terminal()
    for out in (log, terminal):
        with Progress({"fit": 1.0}, stream=out, interval=0.1) as progress:
            progress.begin("fit", (0, 4), "parts")
            time.sleep(0.4)
            progress.end(seconds=0.4)
    assert not set(log.getvalue()) & {"\r", "\x1b"}
    assert terminal.getvalue().count("\n") == 2  # the beginning and the end stay
    assert terminal.getvalue().count("\r") >= 2


def test_nothing_is_said_of_a_run_that_is_to_be_silent() -> None:
    out = io.StringIO()
    with Progress({"fit": 1.0}, enabled=False, stream=out, interval=0.05) as progress:
        progress.begin("fit", (0, 4), "parts")
        time.sleep(0.2)
        progress.end(seconds=0.1)
    assert out.getvalue() == ""


def test_a_closed_pipe_does_not_end_a_run() -> None:
    out = io.StringIO()
    with Progress({"fit": 1.0}, stream=out, interval=0.05) as progress:
        out.close()
        progress.begin("fit", (0, 4), "parts")
        time.sleep(0.15)
        progress.end(seconds=0.1)


def test_loading_ends_where_a_run_begins() -> None:
    out, run = io.StringIO(), io.StringIO()
    with loading("loading it", stream=out):
        assert lines(out) == ["loading it"]
        with Progress({}, stream=run):
            assert not [t for t in threading.enumerate() if t.name == "progress"][1:]


def test_what_a_thread_does_is_read_from_its_stack() -> None:
    names: dict[str, object] = {"__name__": "fitter", "DOING": "fitting"}
    exec("def fit(wait):\n    wait()", names)
    compiler: dict[str, object] = {"__name__": "torch._inductor.compile_fx"}
    exec("def compile(wait):\n    wait()", compiler)
    done = threading.Event()
    for work, words in (
        (lambda: names["fit"](done.wait), "fitting"),  # type: ignore[operator]
        (lambda: compiler["compile"](done.wait), "compiling"),  # type: ignore[operator]
        (
            lambda: names["fit"](lambda: compiler["compile"](done.wait)),  # type: ignore[operator]
            "fitting: compiling for it",
        ),
        (done.wait, ""),
    ):
        done.clear()
        thread = threading.Thread(target=work)
        thread.start()
        time.sleep(0.05)
        assert thread.ident is not None
        assert activity(thread.ident) == words
        done.set()
        thread.join()


def test_own_speed_counts_more_the_more_is_done() -> None:
    forecast = Forecast({"model": 10.0, "policy": 100.0}, clock=lambda: 0.0)
    forecast.begin("model", 0.0)
    assert forecast.now() == (0.0, "about 1 min 50 s left", 0.0)
    forecast.advance(0.5, seconds=10.0)  # 20 s instead of 10
    assert forecast.now()[1] == "about 1 min 50 s left"
    forecast.end(20.0)
    forecast.begin("policy", 0.0)
    assert forecast.now()[1] == "about 3 min 20 s left"  # as much slower as the model was
    forecast.advance(0.1, seconds=10.0)  # half of 90 s by its own speed, half of 180 s foretold
    assert forecast.now()[1] == "about 2 min 15 s left"


def test_time_left_falls_within_a_unit_and_is_not_made_up() -> None:
    now = 0.0
    forecast = Forecast({"fit": 10.0, "play": 30.0, "rest": None}, clock=lambda: now)
    forecast.begin("fit", 0.0)
    now = 4.0
    assert forecast.now() == (pytest.approx(4.0 / 40.0), "at least 36 s left", 4.0)
    now = 11.0
    share, words, _ = forecast.now()
    assert share is None
    assert words == "this part takes longer than expected, then about 30 s"


def test_a_resumed_run_counts_what_was_done_before() -> None:
    forecast = Forecast({"model": 30.0, "policy": 60.0}, clock=lambda: 0.0)
    forecast.restored("model", 30.0)
    forecast.begin("policy", 0.5)
    assert forecast.now()[:2] == (0.5, "about 30 s left")
