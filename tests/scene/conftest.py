import json
import os
import subprocess
import sys
from types import MappingProxyType

import numpy as np
import pytest
import trimesh
from PIL import Image

from jaxfx import OrthographicCamera, PinholeCamera, io, scene
from jaxfx.scene import embree, opengl


def _require(name):
    problem = {"embree": embree, "opengl": opengl}[name].problem()
    if problem:
        pytest.skip(f"{name} does not work here: {problem}")
    return name


@pytest.fixture(params=["embree", "opengl"])
def backend(request):
    """Each backend that works on this machine."""
    return _require(request.param)


@pytest.fixture
def both_backends():
    """The names of both backends, on a machine where both work."""
    return _require("embree"), _require("opengl")


def _cameras():
    pinhole = PinholeCamera.look_at(
        [1.0, 2.0, 6.0], [0.2, 0.1, 0.0], up=[0, 1, 0], fov_y=0.9, height=60, width=83
    )
    intrinsics = np.array(pinhole.intrinsics)
    intrinsics[0, :2] = 1.2 * intrinsics[0, 0], 9.0
    skewed = PinholeCamera(intrinsics, pinhole.world_from_camera)
    return {
        "pinhole": pinhole,
        "off-axis": pinhole.through_lens([0.7, -0.4], focus_distance=5.0),
        "skewed": skewed,
        "orthographic": OrthographicCamera(
            11.0, np.array([40.0, 31.5]), pinhole.world_from_camera
        ),
    }


@pytest.fixture(params=["pinhole", "off-axis", "skewed", "orthographic"])
def camera(request):
    """A camera of 60 x 83 pixels that looks at the origin from a distance of 6."""
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
            local = np.stack([x, y], axis=-1) - np.asarray(camera.center)
            local = local / float(camera.pixels_per_unit)
            near = np.concatenate([local, zero[..., None]], axis=-1)
            ahead = np.stack([zero, zero, one], axis=-1)
        pose = np.asarray(camera.world_from_camera)
        return near @ pose[:3, :3].T + pose[:3, 3], ahead @ pose[:3, :3].T

    return trace


@pytest.fixture
def straight():
    """An orthographic camera whose image is [0, width] x [0, height] of the plane z = 0.

    A pixel is a scene unit; y points up in the world and down in the image.
    """

    def make(height, scale=1.0):
        pose = np.diag([1.0, -1.0, -1.0, 1.0])
        pose[:3, 3] = 0.0, height / scale, 3.0
        return OrthographicCamera(scale, np.zeros(2), pose)

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
    """Run code in a new Python process, with warnings as errors and some libraries missing.

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


class GltfFile:
    """A glTF document, assembled by the standard without any code of the package."""

    KINDS = MappingProxyType(
        {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
    )
    TYPES = MappingProxyType({1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"})

    def __init__(self, folder):
        self.folder, self.binary = folder, b""
        self.json = {"asset": {"version": "2.0"}, "bufferViews": [], "accessors": []}

    def view(self, data, **more):
        self.binary += b"\0" * (-len(self.binary) % 4)
        view = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data)}
        self.json["bufferViews"].append(view | more)
        self.binary += data
        return len(self.json["bufferViews"]) - 1

    def accessor(self, rows, dtype="f4", *, gap=0, **more):
        """An accessor of rows of numbers, with `gap` unused bytes after each row."""
        rows = np.asarray(rows, f"<{dtype}")
        rows = rows.reshape(len(rows), -1)
        data = b"".join(row.tobytes() + b"\xaa" * gap for row in rows)
        stride = {"byteStride": rows[0].nbytes + gap} if gap else {}
        view = {"bufferView": self.view(data, **stride)}
        return self.record(len(rows), rows.shape[1], dtype, **view, **more)

    def record(self, count, width, dtype="f4", **more):
        kind = {"componentType": self.KINDS[dtype], "type": self.TYPES[width], "count": count}
        self.json["accessors"].append(kind | more)
        return len(self.json["accessors"]) - 1

    def quad(self, *, material=None, mode=4, faces=(0, 1, 2, 0, 2, 3), **attributes):
        """A primitive over [0, 3] x [0, 2] of the plane z = 0."""
        corners = [[0, 0, 0], [3, 0, 0], [3, 2, 0], [0, 2, 0]]
        names = {"POSITION": self.accessor(corners)} if "POSITION" not in attributes else {}
        one = {"attributes": names | attributes, "mode": mode}
        if faces is not None:
            one["indices"] = self.accessor(faces, "u2")
        return one | ({} if material is None else {"material": material})

    def material(self, image, sampler=None, **more):
        """A dielectric with an image as base colour; `more` is added to the texture's info."""
        for key in ("images", "textures", "samplers", "materials"):
            self.json.setdefault(key, [])
        self.json["images"].append({"uri": image})
        texture = {"source": len(self.json["images"]) - 1}
        if sampler:
            self.json["samplers"].append(sampler)
            texture["sampler"] = len(self.json["samplers"]) - 1
        self.json["textures"].append(texture)
        info = {"index": len(self.json["textures"]) - 1} | more
        surface = {"metallicFactor": 0, "baseColorTexture": info}
        self.json["materials"].append({"pbrMetallicRoughness": surface})
        return len(self.json["materials"]) - 1

    def save(self, *primitives, name="a.gltf", **top):
        """The file, with one mesh of these primitives at one node, or the nodes of `top`."""
        (self.folder / "a.bin").write_bytes(self.binary)
        whole = {
            "buffers": [{"byteLength": len(self.binary), "uri": "a.bin"}],
            "meshes": [{"primitives": list(primitives)}],
            "nodes": [{"mesh": 0}],
            "scenes": [{"nodes": [0]}],
            "scene": 0,
        }
        (self.folder / name).write_text(json.dumps(whole | self.json | top))
        return self.folder / name


@pytest.fixture
def gltf(tmp_path):
    """A `GltfFile` in the test's folder."""
    return GltfFile(tmp_path)


UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], float)
TEXELS = np.array(
    [
        [[255, 0, 0], [0, 255, 0], [0, 0, 255]],
        [[200, 100, 50], [10, 128, 240], [77, 33, 11]],
    ],
    np.uint8,
)


@pytest.fixture
def uv():
    """Texture coordinates of `GltfFile.quad` that show the image upright; v as in glTF."""
    return UV


@pytest.fixture
def texels(tmp_path):
    """The image `texels.png` in the test's folder, 2 x 3 bytes."""
    Image.fromarray(TEXELS).save(tmp_path / "texels.png")
    return TEXELS


@pytest.fixture
def codes(straight):
    """The image of a mesh over [0, 3] x [0, 2], `scale` pixels per unit, as sRGB bytes."""

    def look(mesh, scale=1):
        buffer = scene.gbuffer(
            mesh,
            straight(2 * scale, scale),
            height=2 * scale,
            width=3 * scale,
            backend="embree",
        )
        return np.rint(255 * io.srgb_from_linear(np.asarray(buffer.color, float))).astype(int)

    return look
