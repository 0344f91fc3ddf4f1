"""Models whose number of contacts or degrees of freedom is a parameter."""

import math
import tempfile
from pathlib import Path

from mjx_study.tasks.mjcf import mjcf_task
from mjx_study.tasks.task import Task


def feet(contacts: int) -> str:
    """Return a free body with spherical feet on a plane: six degrees of freedom, one contact per foot."""
    ring = [2 * math.pi * index / contacts for index in range(contacts)]
    geoms = "".join(
        f'<geom size="0.05" mass="0.1" pos="{0.3 * math.cos(at):.6f} {0.3 * math.sin(at):.6f} 0"/>' for at in ring
    )
    return _mjcf(f'<body pos="0 0 0.049"><freejoint/>{geoms}</body>')


def chain(dof: int) -> str:
    """Return a hanging chain of hinges whose last link touches a plane below: one contact."""
    body, length = '<geom size="0.05" pos="0 0 -0.1" mass="0.1"/>', 0.1 * dof
    for index in reversed(range(dof)):
        at = f"0 0 {length + 0.049:.6f}" if index == 0 else "0 0 -0.1"
        link = '<geom type="capsule" size="0.01" fromto="0 0 0 0 0 -0.1" mass="0.1" contype="0" conaffinity="0"/>'
        body = f'<body pos="{at}"><joint axis="0 1 0" damping="0.01"/>{link}{body}</body>'
    return _mjcf(body)


def _mjcf(world: str) -> str:
    return f"""<mujoco><option timestep="0.005"/><worldbody>
<geom name="floor" type="plane" size="5 5 0.1" contype="0" conaffinity="1"/>{world}</worldbody></mujoco>"""


def task_of(mjcf: str, horizon: int) -> Task:
    """Return the task of an MJCF: the displacement after the horizon, as a function of the initial velocities."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.xml"
        path.write_text(mjcf)
        return mjcf_task(path, horizon=horizon)
