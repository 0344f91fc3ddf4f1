"""What gradcheck is run on to find a defect."""

from typing import Final

from tests.scenes import MECHANISM, floor_scene, option, slider

TENDON: Final = """<mujoco><worldbody><body><joint name="x" type="slide"/><geom size=".1" mass="1"/></body></worldbody>
<tendon><fixed stiffness="100" springlength="0"><joint joint="x" coef="2"/></fixed></tendon></mujoco>"""
BALL: Final = """<mujoco><worldbody><body><joint type="ball" stiffness="10" damping=".1"/>
<geom type="box" pos="0 0 -.1" size=".1 .05 .02" mass="1" contype="0"/></body></worldbody></mujoco>"""
SWING: Final = """<mujoco><option timestep=".02" integrator="RK4"/><worldbody><body><joint name="axle" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -.5" size=".03" mass="1" contype="0"/></body></worldbody>
<actuator><motor joint="axle"/></actuator></mujoco>"""
DOME: Final = f"""<mujoco>{option(extra='cone="elliptic" integrator="implicitfast"')}<worldbody><geom size=".1"/>
<body pos=".03 .01 .1888"><joint type="slide" axis="1 0 0" damping=".4"/><joint type="slide" axis="0 1 0"/>
<joint type="slide" axis="0 0 1"/><geom size=".1" mass=".5" friction=".3"/></body></worldbody></mujoco>"""
MODELS: Final = {
    "slider": floor_scene(slider(3), option(extra='cone="elliptic" impratio="2"')),
    "dome": DOME,
    "mechanism": MECHANISM,
    "tendon": TENDON,
    "ball": BALL,
    "swing": SWING,
}
