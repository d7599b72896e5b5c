"""Square frames of a simulated body; scene and OpenGL context are made once and reused."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from latentplan.envs.gl import explain_gl_errors, require_backend

if TYPE_CHECKING:
    from dm_control.mujoco import Physics

# Values of the model's `visual/quality` by quality. Software renderers take longer for more triangles and samples.
_QUALITY_SETTINGS: dict[str, dict[str, int]] = {
    "exact": {},
    "fast": {"shadowsize": 256},
    "fastest": {"shadowsize": 256, "offsamples": 0},
}


class FrameRenderer:
    """Renders the present state of a body as `Physics.render` does, without repeating the preparations at every frame.

    Shadow map, anti-aliasing and buffer size are fixed when the context is made. The buffer has the size of the frame,
    so that no larger buffer has to be cleared; the picture does not depend on the size of the buffer.
    """

    def __init__(self, physics: Physics, size: int, camera: int, quality: str, slices: int | None) -> None:
        """Makes the OpenGL context and the scene.

        Args:
            physics: The body to render.
            size: Height and width of the frames, in pixels.
            camera: Camera id of the MuJoCo model; -1 is the free camera.
            quality: `exact`, `fast` or `fastest`.
            slices: Flat sides around a round shape, except at quality `exact`; None takes those of the model.

        Raises:
            UserError: No OpenGL context can be made.
        """
        require_backend()
        with explain_gl_errors():
            import mujoco
            from dm_control import _render
            from dm_control.mujoco import wrapper

            self._physics = physics
            self._gl = _render.Renderer(size, size)
            self._context = _make_context(physics, self._gl, size, quality, slices)
        self._rectangle = mujoco.MjrRect(0, 0, size, size)
        self._pixels = np.empty((size, size, 3), dtype=np.uint8)
        self._options = mujoco.MjvOption()
        self._camera = mujoco.MjvCamera()
        self._camera.fixedcamid = camera
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        if camera == -1:
            self._camera.type = mujoco.mjtCamera.mjCAMERA_FREE
            mujoco.mjv_defaultFreeCamera(physics.model.ptr, self._camera)
        self._scene = wrapper.MjvScene(physics.model)
        if quality == "fastest":
            self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
            self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False

    def render(self) -> np.ndarray:
        """A frame of the present state, a new uint8 array (size, size, 3)."""
        import mujoco

        model, data = self._physics.model.ptr, self._physics.data.ptr
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(model, data, self._options, None, self._camera, everything, self._scene)
        with self._gl.make_current() as gl:
            gl.call(self._draw)
        return self._pixels[::-1].copy()  # OpenGL's rows run upwards

    def refresh_terrain(self) -> None:
        """Sends the present terrain to the renderer; for tasks that change the terrain between episodes."""
        import mujoco

        with self._gl.make_current() as gl:
            for heightfield in range(self._physics.model.nhfield):
                gl.call(mujoco.mjr_uploadHField, self._physics.model.ptr, self._context.ptr, heightfield)

    def close(self) -> None:
        """Frees the context; has to be called before `Physics.free`."""
        self._context.free()

    def _draw(self) -> None:
        import mujoco

        mujoco.mjr_render(self._rectangle, self._scene, self._context.ptr)
        mujoco.mjr_readPixels(self._pixels, None, self._rectangle, self._context.ptr)


def draw_floor_behind(physics: Physics) -> None:
    """Moves every floor that begins just behind the start back by half its length.

    The size of a plane affects drawing only: bodies touch an endless plane. After a move by half the length of the
    floor, its pattern and light fall on the same places as before. At least 48 m of floor ahead stay drawn.
    """
    import mujoco

    model = physics.model
    for geom in range(model.ngeom):
        centre, half = model.geom_pos[geom][0], model.geom_size[geom][0]
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE and centre > 0.0 and half > centre:
            model.geom_pos[geom][0] -= half


def _make_context(physics: Physics, gl: object, size: int, quality: str, slices: int | None) -> Any:
    """MuJoCo's drawing context, which reads its settings from the model; the model is restored afterwards."""
    from dm_control.mujoco import wrapper

    visual = physics.model.vis
    buffer_size, before = (visual.global_.offwidth, visual.global_.offheight), {}
    visual.global_.offwidth = visual.global_.offheight = size
    settings = dict(_QUALITY_SETTINGS[quality])
    if slices is not None and quality != "exact":
        own = visual.quality.numslices, visual.quality.numstacks
        settings |= {"numslices": slices, "numstacks": max(2, round(own[1] * slices / own[0]))}
    for name, value in settings.items():
        before[name] = getattr(visual.quality, name)
        setattr(visual.quality, name, value)
    context = wrapper.MjrContext(physics.model, gl)
    visual.global_.offwidth, visual.global_.offheight = buffer_size
    for name, value in before.items():
        setattr(visual.quality, name, value)
    return context
