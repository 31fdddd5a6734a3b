import os
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxfx import OrthographicCamera, PinholeCamera, scene
from jaxfx.scene import _embree, _opengl


def _require(name):
    problem = {"embree": _embree, "opengl": _opengl}[name].problem()
    if problem:
        pytest.skip(f"{name} does not work here: {problem}")
    return name


@pytest.fixture(params=["embree", "opengl"])
def backend(request):
    """Each backend that works on this machine."""
    return _require(request.param)


@pytest.fixture
def both_backends():
    """The two names, where both work."""
    return _require("embree"), _require("opengl")


def _cameras():
    pinhole = PinholeCamera.look_at(
        [1.0, 2.0, 6.0], [0.2, 0.1, 0.0], up=[0, 1, 0], fov_y=0.9, height=60, width=83
    )
    skewed = PinholeCamera(
        pinhole.intrinsics.at[0, 1].set(9.0).at[0, 0].mul(1.2), pinhole.world_from_camera
    )
    return {
        "pinhole": pinhole,
        "off-axis": pinhole.through_lens([0.7, -0.4], focus_distance=5.0),
        "skewed": skewed,
        "orthographic": OrthographicCamera(
            11.0, jnp.array([40.0, 31.5]), pinhole.world_from_camera
        ),
    }


@pytest.fixture(params=["pinhole", "off-axis", "skewed", "orthographic"])
def camera(request):
    """A camera for 60 x 83 pixels that looks at the origin from 6 away."""
    return _cameras()[request.param]


@pytest.fixture
def rays():
    """Origins and directions (of depth 1) through every pixel's centre, from the definition."""

    def trace(camera, height, width):
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        zero, one = np.zeros_like(x), np.ones_like(x)
        if isinstance(camera, PinholeCamera):
            (fx, skew, cx), (_, fy, cy), _ = np.asarray(camera.intrinsics)
            v = (y - cy) / fy
            near = np.stack([zero, zero, zero], axis=-1)
            ahead = np.stack([(x - cx - skew * v) / fx, v, one], axis=-1)
        else:
            local = np.stack([x, y], axis=-1) - np.asarray(camera.centre)
            local = local / float(camera.pixels_per_unit)
            near = np.concatenate([local, zero[..., None]], axis=-1)
            ahead = np.stack([zero, zero, one], axis=-1)
        pose = np.asarray(camera.world_from_camera)
        return near @ pose[:3, :3].T + pose[:3, 3], ahead @ pose[:3, :3].T

    return trace


@pytest.fixture
def straight():
    """An orthographic camera whose picture is [0, width] x [0, height] of the plane z = 0.

    A pixel is a scene unit; y points up in the world and down in the picture.
    """

    def make(height, scale=1.0):
        pose = np.diag([1.0, -1.0, -1.0, 1.0])
        pose[:3, 3] = 0.0, height / scale, 3.0
        return OrthographicCamera(scale, jnp.zeros(2), pose)

    return make


@pytest.fixture
def ball():
    """A ball of radius 1 about the origin."""
    return scene.from_trimesh(trimesh.creation.icosphere(3))


_PREAMBLE = """
import logging, os, sys
for name in {without}:
    sys.modules[name] = None
logging.basicConfig(format="%(name)s: %(message)s", stream=sys.stdout)
logging.getLogger("jaxfx.scene").setLevel(logging.INFO)
import trimesh
from jaxfx import scene
ball = scene.from_trimesh(trimesh.creation.icosphere(2))
camera = scene.default_camera(ball, height=20, width=30)
def depth(backend="auto"):
    return scene.depth(ball, camera, height=20, width=30, backend=backend)
def complain(backend):
    try:
        depth(backend)
    except RuntimeError as error:
        print(error)
"""


@pytest.fixture
def fresh_python():
    """Run code in a Python of its own, in which a warning is an error and libraries lack.

    The code may call `depth(backend)` and `complain(backend)`. It gives what went to the
    standard output and to the standard error.
    """

    def run(code, without=(), **environment):
        kept = {key: value for key, value in os.environ.items() if key != "PYOPENGL_PLATFORM"}
        done = subprocess.run(
            [sys.executable, "-W", "error", "-c", _PREAMBLE.format(without=without) + code],
            env=kept | environment,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout, done.stderr

    return run
