"""Run MuJoCo's renderer in a separate process: `python _opengl_worker.py FOLDER`.

An OpenGL library may abort the process, print, or fail at exit, and MuJoCo chooses its backend (MUJOCO_GL) on import.
This file is therefore executed by path and imports nothing from this package.

Reads model.mjb and request.npz (qpos, camera: lookat, distance, azimuth, elevation; width, height), writes images.npy.
"""

import sys
from pathlib import Path

import mujoco
import numpy as np

FINER = 3  # supersampling factor along each axis, for smooth edges


def main(folder: Path) -> None:
    request = np.load(folder / "request.npz")
    model = mujoco.MjModel.from_binary_path(str(folder / "model.mjb"))
    width, height = int(request["width"]), int(request["height"])
    fine = height * FINER, width * FINER
    model.vis.global_.offheight, model.vis.global_.offwidth = fine
    model.vis.quality.offsamples = 0  # it would blend the edges with the black that nothing is drawn in
    data = mujoco.MjData(model)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = request["lookat"]
    camera.distance, camera.azimuth, camera.elevation = (
        float(request[name]) for name in ("distance", "azimuth", "elevation")
    )
    has_sky = np.any(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX)  # without one the background is black
    images = np.empty((len(request["qpos"]), height, width, 3), np.uint8)
    renderer = mujoco.Renderer(model, *fine)
    for image, qpos in zip(images, request["qpos"], strict=True):
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        renderer.update_scene(data, camera)
        rendered = renderer.render()
        if not has_sky:
            renderer.enable_segmentation_rendering()
            nothing = renderer.render()[:, :, 0] < 0
            renderer.disable_segmentation_rendering()
            rendered[nothing] = 255
        image[:] = rendered.reshape(height, FINER, width, FINER, 3).mean((1, 3)).round()
    renderer.close()
    with (folder / "images.npy").open("wb") as file:
        np.save(file, images)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
