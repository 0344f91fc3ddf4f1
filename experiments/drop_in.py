"""Table of docs/differentiable-mjx.md: `mjx_study.step` against `mjx.step`, on this machine.

    python -m experiments.drop_in
    python -m experiments.drop_in --batch 1024    # on an accelerator

A few minutes on one core, most of it compiling. Stock's gradient is of one solver iteration.
"""

import argparse
import statistics
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

import mjx_study
from experiments import ROOT
from experiments.pages import markdown_row
from experiments.timing import interleaved
from mjx_study.table import markdown_table

TESTED: Final = Path(mjx.__file__).parent / "test_data"
MODELS: Final = {
    "`pusher` of this project": ROOT / "models" / "pusher.xml",
    "`convex`": TESTED / "convex.xml",
    "`barkour_v0`, a quadruped": TESTED / "barkour_v0" / "assets" / "barkour_v0_mjx.xml",
    "`humanoid`": TESTED / "humanoid" / "humanoid.xml",
}
STEPS: Final = 20
REPEATS: Final = 9
SETTLING: Final = 0.3  # time before the first state, in which bodies fall to the floor [s]


def start_states(host: mujoco.MjModel, batch: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a batch of positions and velocities, in contact if the model has a floor."""
    data, noise = mujoco.MjData(host), np.random.default_rng(0)
    if host.nkey:
        mujoco.mj_resetDataKeyframe(host, data, 0)
    while data.time < SETTLING:
        mujoco.mj_step(host, data)
    return np.tile(data.qpos, (batch, 1)), data.qvel + 0.1 * noise.standard_normal((batch, host.nv))


def prepared(
    host: mujoco.MjModel,
    step: Callable[..., mjx.Data],
    iterations: int,
    gradient: bool,
    batch: int,
    control: np.ndarray | None = None,
) -> partial[Any]:
    """Compile a batch of rollouts of `STEPS` steps, or their gradients over initial velocity and controls, to be called
    without arguments; its result is the last positions, or the gradients. The control is 0 by default."""
    model, data = mjx.put_model(host), mjx.make_data(host)
    model = model.replace(opt=model.opt.replace(iterations=iterations))
    qpos, qvel = start_states(host, batch)
    controls = np.broadcast_to(np.zeros(host.nu) if control is None else control, (batch, STEPS, host.nu))
    inputs = jax.device_put((qvel, controls, qpos))

    def last(qvel, controls, qpos):
        def advance(data, control):
            return step(model, data.replace(ctrl=control)), None

        end = jax.lax.scan(advance, data.replace(qpos=qpos, qvel=qvel), controls)[0]
        return jnp.sum(end.qpos) + jnp.sum(end.qvel), end.qpos

    each = jax.grad(last, argnums=(0, 1), has_aux=True) if gradient else last
    compiled = jax.jit(jax.vmap(lambda *inputs: each(*inputs)[0 if gradient else 1])).lower(*inputs).compile()
    return partial(_finished, compiled, inputs)


def _finished(program: Callable[..., Any], inputs: tuple[Any, ...]) -> Any:
    return jax.block_until_ready(program(*inputs))


def measured(path: Path, batch: int) -> dict[str, float]:
    """Return median seconds of a batch of rollouts and of their gradients, through both steps."""
    host = mujoco.MjModel.from_xml_path(str(path))
    budget = int(host.opt.iterations)
    programs = {
        "stock": prepared(host, mjx.step, budget, False, batch),
        "ours": prepared(host, mjx_study.step, budget, False, batch),
        "stock_gradient": prepared(host, mjx.step, 1, True, batch),
        "gradient": prepared(host, mjx_study.step, budget, True, batch),
        "gradient_once": prepared(host, mjx_study.step, 1, True, batch),
    }
    times = interleaved(programs, REPEATS + 1)
    return {name: statistics.median(seconds[1:]) for name, seconds in times.items()} | {"nv": host.nv, "budget": budget}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", type=int, default=64, help="rollouts at once")
    batch = parser.parse_args().batch
    mjx_study.configure(cpu_devices=1)
    header = "model", "DoF", "rollouts / stock", "gradients / stock, one iteration", "gradients / stock, model's budget"
    print(markdown_table([], header))
    for name, path in MODELS.items():
        found = measured(path, batch)
        ratios = [found["stock"] / found["ours"]]
        ratios += [found["stock_gradient"] / found[each] for each in ("gradient_once", "gradient")]
        rollouts, once, full = (f"{ratio:.2f}" for ratio in ratios)
        print(markdown_row(name, found["nv"], rollouts, once, f"{full} ({found['budget']:g})"), flush=True)


if __name__ == "__main__":
    main()
