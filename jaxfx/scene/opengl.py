"""Visible faces by rasterisation, with OpenGL in a windowless context of pyrender's."""

import os
import weakref
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxfx._extras import needs
from jaxfx.scene._scene import Scene
from jaxfx.scene._view import View


_VERTEX = """#version 330 core
layout(location = 0) in vec3 position;
uniform mat4 clip_from_unit;
uniform vec4 depth_from_unit;
out float depth;

void main() {
    gl_Position = clip_from_unit * vec4(position, 1.0);
    depth = dot(depth_from_unit, vec4(position, 1.0));
}
"""

_FRAGMENT = """#version 330 core
in float depth;
uniform sampler2D start;
uniform float farthest;
out int face;

void main() {
    if (depth <= texelFetch(start, ivec2(gl_FragCoord.xy), 0).r) discard;
    gl_FragDepth = depth / farthest;
    face = gl_PrimitiveID;
}
"""

# An OpenGL context belongs to one thread: all calls are made on this one.
_thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="jaxfx.scene.opengl")
# Largest side of the framebuffer, in pixels; larger images are drawn in tiles. More takes more
# memory; some drivers allow less, which is asked for.
_TILE = 4096


@cache
def problem() -> str | None:
    """Why OpenGL can't be used here, or None where it can."""
    is_unset = "PYOPENGL_PLATFORM" not in os.environ
    if is_unset:
        os.environ["PYOPENGL_PLATFORM"] = "egl"
    try:
        _thread.submit(_rasterizer).result()
    except Exception as error:  # A missing library shows as almost any exception.
        if is_unset:
            del os.environ["PYOPENGL_PLATFORM"]
        return f"{type(error).__name__}: {error}"
    return None


def first_faces(
    scene: Scene, view: View, start: Float[np.ndarray, "height width"]
) -> Int[np.ndarray, "height width"]:
    """The first face beyond the depth `start` at each pixel's centre; -1 for none."""
    faces = np.empty(start.shape, np.int32)
    side = _thread.submit(lambda: _rasterizer().side).result()
    for row in range(0, start.shape[0], side):
        for column in range(0, start.shape[1], side):
            tile = slice(row, row + side), slice(column, column + side)
            shift = np.eye(3)
            shift[:2, 2] = -column, -row
            tile_view = view._replace(intrinsics=shift @ view.intrinsics)
            faces[tile] = _faces_of_tile(scene, tile_view, start[tile])
    return faces


def _faces_of_tile(
    scene: Scene, view: View, start: Float[np.ndarray, "height width"]
) -> Int[np.ndarray, "height width"]:
    """As `first_faces`, for an image no larger than the framebuffer."""
    height, width = start.shape
    clip, depth, farthest = _transforms(scene, view, height, width)
    if farthest <= 0:
        return np.full((height, width), -1, np.int32)
    unit_start = np.ascontiguousarray(start / scene.radius, np.float32)
    draw = lambda: _rasterizer().draw(scene, clip, depth, farthest, unit_start)
    return _thread.submit(draw).result()


def _transforms(
    scene: Scene, view: View, height: int, width: int
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "4"], float]:
    """The maps from unit triangles to clip space, 4x4, and to depth, 4; and the largest depth.

    Depths are in units of the scene's radius. The y of clip space points down, so that the
    framebuffer's first row is the image's top. In perspective its z is 0: nothing is clipped
    but what lies behind the eye, and the fragment shader computes the depth that is tested.
    """
    rotation, eye = view.world_from_camera[:3, :3], view.world_from_camera[:3, 3]
    offset = rotation.T @ (scene.center - eye) / scene.radius
    x, y, depth = np.column_stack([rotation.T, offset])
    constant = np.array([0.0, 0.0, 0.0, 1.0])
    box = (scene.bounds - scene.center) / scene.radius
    # A little beyond the box, so that rounding leaves its farthest corner below depth 1.
    farthest = 1.0001 * float(np.maximum(*(box * depth[:3])).sum() + depth[3])
    if view.perspective:
        w, z = depth, 0 * depth
        u, v, _ = view.intrinsics @ np.stack([x, y, depth])
    else:
        w, z = constant, 2 * depth / max(farthest, 1e-30) - constant
        u, v, _ = view.intrinsics @ np.stack([x * scene.radius, y * scene.radius, constant])
    return np.stack([2 / width * u - w, 2 / height * v - w, z, w]), depth, farthest


@cache
def _rasterizer() -> "_Rasterizer":
    """The one rasteriser of the process; to be called on `_thread` only."""
    return _Rasterizer()


class _Rasterizer:
    """An OpenGL context and program, with buffers for the scene and image size drawn last."""

    def __init__(self):
        with needs("scene"):
            import pyrender
            from OpenGL import GL
            from OpenGL.GL import shaders

        self.gl = GL
        self.context = pyrender.OffscreenRenderer(1, 1)
        self.program = shaders.compileProgram(
            shaders.compileShader(_VERTEX, GL.GL_VERTEX_SHADER),
            shaders.compileShader(_FRAGMENT, GL.GL_FRAGMENT_SHADER),
            validate=False,
        )
        limits = (GL.GL_MAX_RENDERBUFFER_SIZE, GL.GL_MAX_TEXTURE_SIZE)
        self.side = min(_TILE, *(int(GL.glGetIntegerv(limit)) for limit in limits))
        self.vertex_array = GL.glGenVertexArrays(1)
        self.corners = GL.glGenBuffers(1)
        self.framebuffer = GL.glGenFramebuffers(1)
        self.faces, self.depth = GL.glGenRenderbuffers(2)
        self.start = GL.glGenTextures(1)
        self.scene = lambda: None
        self.size = (0, 0)

    def draw(
        self,
        scene: Scene,
        clip: Float[np.ndarray, "4 4"],
        depth: Float[np.ndarray, "4"],
        farthest: float,
        start: Float[np.ndarray, "height width"],
    ) -> Int[np.ndarray, "height width"]:
        """The face at each pixel, -1 for none; arguments are those of `_transforms`."""
        gl = self.gl
        height, width = start.shape
        gl.glBindVertexArray(self.vertex_array)
        if self.scene() is not scene:
            self._upload(scene)
        gl.glBindFramebuffer(gl.GL_FRAMEBUFFER, self.framebuffer)
        if self.size != (height, width):
            self._resize(height, width)
        gl.glViewport(0, 0, width, height)
        gl.glDisable(gl.GL_CULL_FACE)
        gl.glEnable(gl.GL_DEPTH_TEST)
        gl.glDepthFunc(gl.GL_LESS)
        gl.glDepthMask(True)
        gl.glUseProgram(self.program)
        self._set("clip_from_unit", gl.glUniformMatrix4fv, 1, True, clip.astype(np.float32))
        self._set("depth_from_unit", gl.glUniform4f, *depth)
        self._set("farthest", gl.glUniform1f, farthest)
        self._set("start", gl.glUniform1i, 0)
        gl.glActiveTexture(gl.GL_TEXTURE0)
        gl.glBindTexture(gl.GL_TEXTURE_2D, self.start)
        gl.glTexSubImage2D(
            gl.GL_TEXTURE_2D, 0, 0, 0, width, height, gl.GL_RED, gl.GL_FLOAT, start
        )
        gl.glClearBufferiv(gl.GL_COLOR, 0, np.array([-1, 0, 0, 0], np.int32))
        gl.glClearBufferfv(gl.GL_DEPTH, 0, np.array([1], np.float32))
        gl.glDrawArrays(gl.GL_TRIANGLES, 0, scene.unit_triangles.size // 3)
        faces = np.empty((height, width), np.int32)
        gl.glReadPixels(0, 0, width, height, gl.GL_RED_INTEGER, gl.GL_INT, faces)
        return faces

    def _set(self, name: str, setter: Any, *value: Any) -> None:
        """Set a uniform of the program."""
        setter(self.gl.glGetUniformLocation(self.program, name), *value)

    def _upload(self, scene: Scene) -> None:
        """Put a scene's corners into the vertex buffer."""
        gl = self.gl
        corners = scene.unit_triangles
        gl.glBindBuffer(gl.GL_ARRAY_BUFFER, self.corners)
        gl.glBufferData(gl.GL_ARRAY_BUFFER, corners.nbytes, corners, gl.GL_STATIC_DRAW)
        gl.glEnableVertexAttribArray(0)
        gl.glVertexAttribPointer(0, 3, gl.GL_FLOAT, False, 0, None)
        self.scene = weakref.ref(scene)

    def _resize(self, height: int, width: int) -> None:
        """Allocate the framebuffer and the texture of start depths for an image size."""
        gl = self.gl
        for buffer, storage, attachment in (
            (self.faces, gl.GL_R32I, gl.GL_COLOR_ATTACHMENT0),
            (self.depth, gl.GL_DEPTH_COMPONENT32F, gl.GL_DEPTH_ATTACHMENT),
        ):
            gl.glBindRenderbuffer(gl.GL_RENDERBUFFER, buffer)
            gl.glRenderbufferStorage(gl.GL_RENDERBUFFER, storage, width, height)
            gl.glFramebufferRenderbuffer(
                gl.GL_FRAMEBUFFER, attachment, gl.GL_RENDERBUFFER, buffer
            )
        state = gl.glCheckFramebufferStatus(gl.GL_FRAMEBUFFER)
        if state != gl.GL_FRAMEBUFFER_COMPLETE:
            raise RuntimeError(f"OpenGL gives no framebuffer of {width} x {height}: {state}.")
        gl.glBindTexture(gl.GL_TEXTURE_2D, self.start)
        for key in (gl.GL_TEXTURE_MIN_FILTER, gl.GL_TEXTURE_MAG_FILTER):
            gl.glTexParameteri(gl.GL_TEXTURE_2D, key, gl.GL_NEAREST)
        gl.glTexImage2D(
            gl.GL_TEXTURE_2D, 0, gl.GL_R32F, width, height, 0, gl.GL_RED, gl.GL_FLOAT, None
        )
        self.size = (height, width)
