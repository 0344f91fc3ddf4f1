"""Threads compute side by side, LAPACK calls do not wait for each other for ever, a watchdog ends what stands still."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

POOL = "PJRT_NPROC", "MJX_STUDY_THREADS"
SETTINGS = {"text": True, "env": {name: value for name, value in os.environ.items() if name not in POOL}}
CALLS = """
import sys, threading
import jax, jax.numpy as jnp
from mjx_study.runtime import configure, local_devices

if "configured" in sys.argv:
    configure(cpu_devices=2)
    assert len(local_devices()) == 2
matrices = jnp.tile(20 * jnp.eye(18), (2000, 1, 1))
program = jax.jit(lambda batch: sum(jnp.linalg.inv(batch + i).sum() + jnp.linalg.cholesky(batch + i).sum()
                                    for i in range(8)))
threads = [threading.Thread(target=lambda: jax.device_get(program(matrices)), daemon=True) for _ in range(2)]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
print("done")
"""
SIDE_BY_SIDE = """
import threading
from pathlib import Path
import jax, jax.numpy as jnp
from mjx_study.graph.scalars import unrolled
from mjx_study.runtime import configure

def used():  # processor time by thread
    stats = {each.name: (each / "stat").read_text() for each in Path("/proc/self/task").iterdir()}
    fields = {name: each.rpartition(")")[2].split() for name, each in stats.items()}
    return {name: int(each[11]) + int(each[12]) for name, each in fields.items()}

def heavy(x):
    for _ in range(300):
        x = jnp.sin(x) + 0.1
    return x

def step(x, _):
    return unrolled(heavy, x), (x, jnp.stack([2 * x, x]), jnp.linalg.norm(jnp.stack([x, x * x])))

configure(cpu_devices=2)
points = jnp.linspace(0, 1, 2000)
program = jax.jit(jax.vmap(lambda x: jax.lax.scan(step, x, None, length=100))).lower(points).compile()
jax.device_get(program(points))
before, met = used(), threading.Barrier(3)

def work():
    for _ in range(5):
        jax.device_get(program(points))
    met.wait()
    met.wait()

for _ in range(2):
    threading.Thread(target=work).start()
met.wait()
spent = [ticks - before.get(name, 0) for name, ticks in used().items()]
met.wait()
print(max(spent) / sum(spent))
"""
WATCHED = """
import sys, time
import jax, jax.numpy as jnp
from mjx_study.compiled import Compiled
from mjx_study.runtime import configure
from mjx_study.watchdog import watch

def stay(value):
    until = time.monotonic() + float(sys.argv[2])
    while time.monotonic() < until:
        sum(range(100_000)) if sys.argv[1] == "busy" else time.sleep(0.1)
    return value

configure(cpu_devices=1)
one = jnp.ones(())
program = Compiled(lambda x: jax.pure_callback(stay, x, x))
watch(lambda line: print(line, file=sys.stderr), seconds=2, tick=0.1)
print("begun", flush=True)
if sys.argv[1] == "reading":
    sys.stdin.read()
else:
    jax.device_get(program(one))
print("done")
"""
MODEL = """
<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1"/>
    <body name="base" pos="0 0 0.055">
      <freejoint/>
      <geom name="base" size="0.05" mass="1"/>
      {}
    </body>
  </worldbody>
  <actuator><motor joint="j0"/></actuator>
</mujoco>
"""


def run(script: str, *arguments: str, seconds: float = 120) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", script, *arguments]
    return subprocess.run(command, capture_output=True, timeout=seconds, **SETTINGS)


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="a pool of one thread does not split LAPACK calls")
def test_lapack_calls_side_by_side_end() -> None:
    """Two threads with programs of 16 factorisations each, all of which jaxlib 0.10 would split."""
    assert run(CALLS, "configured").stdout == "done\n"


def test_programs_of_several_threads_run_side_by_side() -> None:
    """No thread does nearly all of the work, as one did for everybody when XLA's pool had no other."""
    assert float(run(SIDE_BY_SIDE).stdout) < 0.7


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="a pool of one thread does not split LAPACK calls")
@pytest.mark.slow
def test_the_pool_is_what_makes_them_end() -> None:
    """With jaxlib's default pool they hang; if they end, `configure` may leave it alone."""
    import jax

    if jax.__version_info__ >= (0, 11):
        pytest.skip("mended in jaxlib 0.11")
    with pytest.raises(subprocess.TimeoutExpired):
        run(CALLS, seconds=60)


def test_a_computation_that_stands_still_ends_the_run() -> None:
    done = run(WATCHED, "idle", "1000")
    assert done.returncode == 1 and done.stdout == "begun\n"
    (line,) = done.stderr.splitlines()
    assert line.startswith("the computation stands still: no processor time for 2 s; try again with --devices 1")


def test_a_busy_one_goes_on() -> None:
    done = run(WATCHED, "busy", "5")
    assert (done.returncode, done.stdout, done.stderr) == (0, "begun\ndone\n", "")


def test_waiting_for_input_is_no_standstill() -> None:
    command = [sys.executable, "-c", WATCHED, "reading"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, **SETTINGS) as process:
        assert process.stdin and process.stdout and process.stdout.readline() == "begun\n"
        time.sleep(4)
        process.stdin.close()
        assert process.stdout.read() == "done\n" and process.wait() == 0


def test_a_suspended_run_goes_on() -> None:
    """Stopped for longer than the watchdog waits, in the middle of a computation that is idle for less."""
    command = [sys.executable, "-c", WATCHED, "idle", "4.5"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, **SETTINGS) as process:
        assert process.stdout and process.stdout.readline() == "begun\n"
        time.sleep(0.5)
        process.send_signal(signal.SIGSTOP)
        time.sleep(4)
        process.send_signal(signal.SIGCONT)
        assert process.stdout.read() == "done\n" and process.wait() == 0


def model(hinges: int) -> str:
    body = "".join(
        f'<body pos="0.05 0 0"><joint name="j{i}" axis="0 1 0" damping="0.1"/><geom size="0.02" mass="0.1"/>'
        for i in range(hinges)
    )
    return MODEL.format(body + "</body>" * hinges)


@pytest.mark.slow
@pytest.mark.parametrize("onset", ["none", "linear"])
@pytest.mark.parametrize("hinges", [3, 12, 21])
def test_large_models_on_two_devices(hinges: int, onset: str, tmp_path: Path) -> None:
    """Chunks of 201 samples of models of 9 to 27 degrees of freedom; references have more than one."""
    (tmp_path / "chain.xml").write_text(model(hinges))
    command = f"compare chain.xml --horizon 4 --samples 201 --reference-samples 301 --devices 2 --onset {onset}"
    done = subprocess.run(
        [sys.executable, "-m", "mjx_study", *command.split()],
        capture_output=True, cwd=tmp_path, **SETTINGS, timeout=1200,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
