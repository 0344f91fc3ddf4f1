"""Progress on standard error: a sign of life after each silence, counters that never run backwards, names of builds."""

import threading
import time
from concurrent.futures import Future

import jax
import jax.numpy as jnp
import pytest

from mjx_study.cli import display as module
from mjx_study.cli import output
from mjx_study.cli.display import FIRST, SILENCE, WITHIN, Activity, Display
from mjx_study.compiled import Compiled
from mjx_study.graph import build

TRACED, COMPILED = (event for event in module.EVENTS if "mlir" not in event)
Shown = tuple[float, int, int, str]


class Watched:
    """A display on a clock that is set by hand."""

    def __init__(self) -> None:
        self.now, self.shown = 0.0, list[Shown]()
        self.activity = Activity(lambda: self.now)
        self.display = Display(self._show, self.activity, lambda: self.now)

    def _show(self, done: int, total: int, what: str, life: str) -> None:
        self.shown.append((self.now, done, total, life or what))

    def wait(self, seconds: int) -> None:
        for _ in range(seconds):
            self.now += 1.0
            self.display.tick()


def test_a_computation_is_never_silent_for_ten_seconds() -> None:
    watched = Watched()
    watched.display.report(0, 4, "cell 1")
    watched.wait(100)
    watched.display.report(1, 4, "cell 2")
    watched.wait(7)
    times = [time for time, *_ in watched.shown]
    assert times[:3] == [0.0, FIRST, FIRST + SILENCE] and SILENCE < 10
    assert max(later - earlier for earlier, later in zip(times, times[1:], strict=False)) <= SILENCE
    assert watched.shown[1][3] == "computing, 0 of 4" and watched.shown[-1][3] == "cell 2"
    watched.wait(10)
    assert watched.shown[-1][3] == "computing, 1 of 4, at most 284 s left"  # 300 less the 16 since then
    watched.display.report(2, 4, "cell 3")
    watched.wait(10)
    assert watched.shown[-1][3] == "computing, 2 of 4, about 26 s left"  # cell 2 took 17 s; 8 have passed


def test_counters_never_run_backwards_and_stages_are_not_repeated() -> None:
    watched = Watched()
    reports = [(10, 60, "descent; cost 3"), (30, 60, "descent; cost 2"), (20, 60, "descent; cost 1"), (60, 60, "end")]
    for index, report in enumerate(reports):
        watched.now = index * WITHIN
        watched.display.report(*report)
        watched.display.report(*report)
    watched.now += 1.0
    watched.display.report(60, 60, "end; and so on")  # too soon after the last line of the stage
    assert [each[1:] for each in watched.shown] == [
        (10, 60, "descent; cost 3"), (30, 60, "descent; cost 2"), (30, 60, "descent; cost 1"), (60, 60, "end"),
    ]  # fmt: skip


def test_signs_of_life_name_the_outermost_build_of_each_thread_and_native_code(monkeypatch: pytest.MonkeyPatch) -> None:
    watched = Watched()
    watched.activity.began(TRACED, 0.0, fun_name="value")
    watched.activity.began(TRACED, 0.0, fun_name="cos")
    other = threading.Thread(
        target=watched.activity.began, args=(COMPILED, 0.0), kwargs={"fun_name": "jit(some_thing)"}
    )
    other.start()
    other.join()
    watched.wait(1)
    assert watched.shown[-1][3] == "tracing rollouts, 1 s; compiling some thing, 1 s"
    for _ in range(2):
        watched.activity.ended(TRACED, 1.0)
    monkeypatch.setattr(build, "_BUILT", {"one": Future(), "two": Future()})
    assert watched.activity.describe() == "compiling some thing, 1 s; building 2 libraries of native code"
    watched.activity.ended("/jax/another_event", 1.0)


def test_jax_says_what_it_builds(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(module, "TICK", 0.05)
    monkeypatch.setattr(output, "Activity", lambda: activity)
    activity = Activity()
    seen: list[str] = []

    def slow(x: jax.Array) -> jax.Array:
        time.sleep(0.7)
        seen.append(activity.describe())
        return jnp.sin(x)

    with output.shown_progress() as progress:
        progress(0, 1, "a stage")
        Compiled(slow, "value")(1.0)
        assert not activity.describe().startswith("tracing")
    assert seen == ["tracing rollouts, 1 s"]
    assert "[0/1] a stage" in capsys.readouterr().err
