"""Names of joints and of the entries of qpos, with their units."""

import mujoco

_PARTS = {
    int(mujoco.mjtJoint.mjJNT_FREE): [
        *((f", {axis}", "m") for axis in "xyz"),
        *((f", q{axis}", "") for axis in "wxyz"),
    ],
    int(mujoco.mjtJoint.mjJNT_BALL): [(f", q{axis}", "") for axis in "wxyz"],
    int(mujoco.mjtJoint.mjJNT_SLIDE): [("", "m")],
    int(mujoco.mjtJoint.mjJNT_HINGE): [("", "rad")],
}


def joint_name(host: mujoco.MjModel, joint: int) -> str:
    """A joint's name, or its body's if it is unnamed."""
    body = host.body(host.jnt_bodyid[joint]).name
    return host.joint(joint).name or (f"joint {joint} of {body}" if body else f"joint {joint}")


def coordinates(host: mujoco.MjModel) -> list[tuple[str, str]]:
    """Name and unit of each entry of qpos; no unit for those of quaternions."""
    joints = enumerate(host.jnt_type.tolist())
    return [(joint_name(host, joint) + part, unit) for joint, kind in joints for part, unit in _PARTS[kind]]
