"""OpenGL: one context for all threads, sizes and scenes; a machine without OpenGL."""

import gc
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import trimesh

from jaxfx import PinholeCamera, scene


SIZE = {"height": 20, "width": 30}


def test_sizes_and_scenes_may_change_from_call_to_call(backend):
    ball = scene.from_trimesh(trimesh.creation.icosphere(2))
    box = scene.from_trimesh(trimesh.creation.box((4, 4, 4)))
    view = {"up": [0, 1, 0], "fov_y": 0.8}
    for height, width in [(20, 30), (35, 11), (20, 30)]:
        size = {"height": height, "width": width}
        camera = PinholeCamera.look_at([0, 0, 6], [0, 0, 0], **view, **size)
        for thing, nearest in [(ball, 5), (box, 4), (ball, 5)]:
            depth = scene.depth(thing, camera, **size, backend=backend)
            assert depth.shape == (height, width)
            assert float(depth.min()) == pytest.approx(nearest, abs=0.1)
            other = scene.depth(thing, camera, **size, backend="embree")
            assert np.mean(np.isfinite(depth) == np.isfinite(other)) > 0.99


@pytest.mark.full
def test_a_scene_that_is_gone_makes_room(backend, ball):
    """Buffers belong to a scene, not to an address that a new scene may get."""
    view = scene.default_camera(ball, **SIZE)
    for sides in (3, 4, 6, 12, 3, 12, 4):
        prism = trimesh.creation.cylinder(0.8, 0.8, sections=sides)
        ids = scene.object_ids(scene.from_trimesh(prism), view, **SIZE, backend=backend)
        again = scene.object_ids(scene.from_trimesh(prism), view, **SIZE, backend="embree")
        assert np.mean(ids == again) > 0.98
        gc.collect()


def test_any_thread_may_call(backend, ball):
    view = scene.default_camera(ball, **SIZE)
    draw = lambda _: np.asarray(scene.depth(ball, view, **SIZE, backend=backend))
    with ThreadPoolExecutor(4) as pool:
        for depth in pool.map(draw, range(8)):
            np.testing.assert_array_equal(depth, draw(0))


def test_subpixel_snapping_bends_no_plane(straight):
    """A rasteriser's grid of 1/256 pixel may give a pixel to the wrong side of a diagonal."""
    quad = [[-7, -5, -4], [9, -3, 0.5], [9, 9, 2], [-7, 7, -2.5]]
    random = np.random.default_rng(2)
    for _ in range(20):
        share = random.uniform(0.2, 0.8)
        middle = (1 - share) * np.array(quad[0]) + share * np.array(quad[2])
        fan = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]
        mesh = trimesh.Trimesh([*quad, middle], fan, process=False)
        depth = scene.depth(
            scene.from_trimesh(mesh), straight(4, 10), height=40, width=40, backend="auto"
        )
        slopes = np.diff(depth, axis=1), np.diff(depth, axis=0)
        for slope in slopes:
            np.testing.assert_allclose(slope, slope[0, 0], atol=2e-5)


@pytest.mark.parametrize("size", [1.0, 1e3, 1e5])
def test_a_box_close_by_in_a_large_dome(backend, size):
    """A near object is visible in a scene that is much larger."""
    dome = trimesh.creation.icosphere(2, radius=3 * size)
    world = scene.from_trimesh(trimesh.Scene([trimesh.creation.box((1, 1, 1)), dome]))
    for away in (0.5, 0.01):
        camera = PinholeCamera.look_at(
            [0, 0, 0.5 + away], [0, 0, 0], up=[0, 1, 0], fov_y=0.6, height=3, width=3
        )
        depth = scene.depth(world, camera, height=3, width=3, backend=backend)
        np.testing.assert_allclose(depth, away, rtol=1e-5)


def test_a_floor_below_the_eye(backend):
    """The floor extends from the front of the eye's plane to behind it."""
    floor = trimesh.Trimesh(
        [[-99, -1, -99], [99, -1, -99], [99, -1, 99], [-99, -1, 99]], [[0, 2, 1], [0, 3, 2]]
    )
    camera = PinholeCamera.look_at(
        [0, 0, 0], [0, -1, -1], up=[0, 1, 0], fov_y=1.5, height=8, width=6
    )
    depth = scene.depth(scene.from_trimesh(floor), camera, height=8, width=6, backend=backend)
    angle = np.arctan(np.tan(0.75) * (np.arange(8) - 3.5) / 4)
    expected = np.cos(angle) / np.cos(np.pi / 4 - angle)
    np.testing.assert_allclose(depth[:, 3], expected, rtol=1e-5)


@pytest.mark.parametrize(("height", "width"), [(2, 20000), (20000, 1)])
def test_wider_than_opengl_draws_at_once(backend, straight, height, width):
    """A row of squares of 125 pixels, larger than a tile, of different faces."""
    side, count = 125, 160
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    step = np.array([1, 0, 0] if width > height else [0, 1, 0])
    vertices = np.concatenate([corners + i * step for i in range(count)])
    faces = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * i for i in range(count)])
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    row = scene.from_trimesh(mesh)
    owned = scene.Scene(
        **{
            name: getattr(row, name)
            for name in ("vertices", "faces", "normals", "uv", "colors")
        },
        materials=row.materials,
        face_materials=row.face_materials,
        names=tuple(map(str, range(count))),
        face_objects=np.repeat(np.arange(count), 2),
    )
    ids = scene.object_ids(
        owned, straight(height, side), height=height, width=width, backend=backend
    )
    along = np.arange(20000) // side
    expected = along if width > height else along[::-1, None]
    np.testing.assert_array_equal(ids, np.broadcast_to(expected, (height, width)))


@pytest.mark.full
def test_without_embree_and_opengl(fresh_python):
    printed, complaint = fresh_python(
        "complain('embree'); complain('auto')",
        without=("embreex",),
        PYOPENGL_PLATFORM="nonsense",
    )
    assert '`scene.depth(backend="embree")` does not work on this machine: ' in printed
    assert "no backend of `jaxfx.scene` works on this machine: opengl: " in printed
    assert "; embree: " in printed
    assert complaint == ""


@pytest.mark.parametrize(
    ("without", "environment"),
    [((), {"PYOPENGL_PLATFORM": "nonsense"}), (("pyrender",), {}), (("OpenGL",), {})],
)
@pytest.mark.full
def test_without_opengl(fresh_python, without, environment):
    """Embree is chosen and logged once, OpenGL is refused, the environment is unchanged."""
    printed, complaint = fresh_python(
        "assert (depth() == depth('embree')).all()\n"
        "depth()\n"
        "complain('opengl')\n"
        "print(os.environ.get('PYOPENGL_PLATFORM'))",
        without=without,
        **environment,
    )
    assert printed.count("jaxfx.scene: scenes are rendered with embree (opengl: ") == 1
    assert '`scene.depth(backend="opengl")` does not work on this machine: ' in printed
    assert printed.splitlines()[-1] == environment.get("PYOPENGL_PLATFORM", "None")
    assert complaint == ""


@pytest.mark.full
def test_with_opengl_auto_takes_it_and_exits_quietly(both_backends, fresh_python):
    printed, complaint = fresh_python(
        "depth('embree')\n"
        "assert not {'pyrender', 'OpenGL'} & set(sys.modules)\n"
        "depth(); depth('embree'); depth()"
    )
    assert printed == "jaxfx.scene: scenes are rendered with opengl\n"
    assert complaint == ""
