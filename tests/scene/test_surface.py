"""G-buffers against closed forms and a loop over all triangles; both backends compared."""

import functools

import jax
import numpy as np
import pytest
import trimesh

from jaxfx import OrthographicCamera, PinholeCamera, scene


HEIGHT, WIDTH = 60, 83
SIZE = {"height": HEIGHT, "width": WIDTH}

# A mask of NumPy takes part of a NumPy array without compiling anything.
in_numpy = functools.partial(jax.tree.map, np.asarray)


def clutter(seed=5, count=60):
    """Large triangles about the origin, of all orientations, that intersect one another."""
    random = np.random.default_rng(seed)
    corners = random.uniform(-1.5, 1.5, (count, 1, 3)) + random.uniform(
        -1.5, 1.5, (count, 3, 3)
    )
    content = trimesh.Scene()
    for half in (corners[: count // 2], corners[count // 2 :]):
        faces = np.arange(half.size // 3).reshape(-1, 3)
        content.add_geometry(trimesh.Trimesh(half.reshape(-1, 3), faces, process=False))
    return scene.from_trimesh(content)


def every_hit(triangles, near, direction):
    """The depth at which each ray meets each triangle, inf for none: height width face."""
    a, b, c = triangles.transpose(1, 0, 2)
    shape = (*near.shape[:2], len(triangles), 3)
    toward = np.broadcast_to(direction[:, :, None], shape)
    columns = np.stack([toward, *np.broadcast_arrays(a - b, a - c, toward)[:2]], axis=-1)
    solved = np.linalg.solve(columns, (a - near[:, :, None])[..., None])[..., 0]
    t, u, v = np.moveaxis(solved, -1, 0)
    return np.where((t > 0) & (u >= 0) & (v >= 0) & (u + v <= 1), t, np.inf)


def away_from_edges(*ids):
    """Pixels whose neighbours all have the same id."""
    same = np.ones(ids[0].shape, bool)
    for image in map(np.asarray, ids):
        same[1:] &= image[1:] == image[:-1]
        same[:-1] &= image[1:] == image[:-1]
        same[:, 1:] &= image[:, 1:] == image[:, :-1]
        same[:, :-1] &= image[:, 1:] == image[:, :-1]
    return same


def plane():
    """A large slanted quad through (0, -1, 0), and its unit normal."""
    corners = np.array([[-30, -3, 30], [30, -4, 30], [30, 2, -30], [-30, 3, -30]], float)
    normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
    corners[2] = corners[1] + corners[3] - corners[0]
    mesh = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    return scene.from_trimesh(mesh), corners[0], normal / np.linalg.norm(normal)


def test_depth_and_normal_of_a_plane(camera, backend, rays):
    flat, point, normal = plane()
    near, direction = rays(camera, HEIGHT, WIDTH)
    expected = ((point - near) @ normal) / (direction @ normal)
    seen = expected > 0
    buffer = in_numpy(scene.gbuffer(flat, camera, **SIZE, backend=backend))
    met = np.isfinite(buffer.depth)
    assert met.mean() > 0.6
    assert not (met & ~seen).any()
    np.testing.assert_allclose(buffer.depth[met], expected[met], rtol=1e-5)
    facing = np.where(direction @ normal < 0, 1, -1)[..., None] * normal
    np.testing.assert_allclose(buffer.normal[met], facing[met], atol=1e-6)


def test_depth_and_normal_of_a_sphere(camera, backend, rays):
    radius, centre = 1.3, np.array([0.2, 0.1, -0.3])
    ball = trimesh.creation.icosphere(5, radius=radius)
    ball.vertex_normals = ball.vertices
    ball.apply_translation(centre)
    near, direction = rays(camera, HEIGHT, WIDTH)
    a = (direction**2).sum(-1)
    b = (direction * (near - centre)).sum(-1)
    c = ((near - centre) ** 2).sum(-1) - radius**2
    expected = (-b - np.sqrt(np.where(b * b > a * c, b * b - a * c, np.nan))) / a
    normal = (near + expected[..., None] * direction - centre) / radius
    frontal = -(direction * normal).sum(-1) / np.sqrt(a)
    buffer = in_numpy(scene.gbuffer(scene.from_trimesh(ball), camera, **SIZE, backend=backend))
    met = np.isfinite(buffer.depth)
    assert met[frontal > 0.2].all()
    assert not met[np.isnan(expected)].any()
    # The chord of the longest edge lies this far inside.
    sagitta = (ball.edges_unique_length.max() ** 2) / (6 * radius)
    inner = frontal > 0.2
    error = np.abs(np.asarray(buffer.depth) - expected)[inner] * frontal[inner]
    assert inner.sum() > 300
    assert error.max() < sagitta < 4e-4
    np.testing.assert_allclose(buffer.normal[inner], normal[inner], atol=2e-2)


def test_every_pixel_against_a_loop_over_all_triangles(camera, backend, rays):
    cluttered = clutter()
    triangles = cluttered.vertices[cluttered.faces]
    half = {"height": HEIGHT // 2, "width": WIDTH // 2}
    depths = every_hit(triangles, *rays(camera, *half.values()))
    nearest = depths.min(axis=-1)
    expected = np.where(
        np.isfinite(nearest), cluttered.face_objects[depths.argmin(axis=-1)], -1
    )
    ids = np.asarray(scene.object_ids(cluttered, camera, **half, backend=backend))
    depth = scene.depth(cluttered, camera, **half, backend=backend)
    assert np.mean(ids == expected) > 0.999
    assert np.mean(ids >= 0) > 0.2
    assert set(np.unique(expected)) == {-1, 0, 1}
    same = (ids == expected) & np.isfinite(nearest)
    close = np.isclose(depth, nearest, rtol=1e-5)
    assert close[same].mean() > 0.998


def test_second_layer_against_a_loop_over_all_triangles(camera, backend, rays):
    cluttered = clutter(seed=6)
    triangles = cluttered.vertices[cluttered.faces]
    half = {"height": HEIGHT // 2, "width": WIDTH // 2}
    near, direction = rays(camera, *half.values())
    depths = every_hit(triangles, near, direction)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    back = direction @ normals.T > 0
    first = depths.min(axis=-1, keepdims=True)
    behind = np.where(back | (depths <= first * (1 + 1e-9)), np.inf, depths)
    for layer in (1, 2):
        expected = behind.min(axis=-1)
        depth = scene.depth(cluttered, camera, **half, backend=backend, layer_index=layer)
        agree = np.isclose(depth, expected, rtol=1e-5) | (np.isinf(depth) & np.isinf(expected))
        assert agree.mean() > 0.995
        assert np.isfinite(expected).mean() > 0.05
        behind = np.where(behind <= expected[..., None], np.inf, behind)


def test_backends_agree(camera, both_backends):
    room = scene.still_life()
    embree, opengl = both_backends
    size = {"height": 120, "width": 166}
    if isinstance(camera, PinholeCamera):
        room_camera = PinholeCamera(
            np.asarray(camera.intrinsics) * [[2], [2], [1]],
            scene.default_camera(room, **size).world_from_camera,
        ).through_lens([0.05, -0.02], focus_distance=2.8)
    else:
        room_camera = OrthographicCamera(30.0, np.array([83.0, 60.0]), camera.world_from_camera)
    ids = [
        in_numpy(scene.object_ids(room, room_camera, **size, backend=b))
        for b in (embree, opengl)
    ]
    depth = [
        in_numpy(scene.depth(room, room_camera, **size, backend=b)) for b in (embree, opengl)
    ]
    assert len(np.unique(ids[0])) > 6
    assert np.mean(ids[0] == ids[1]) > 0.999
    inner = away_from_edges(*ids)
    assert inner.mean() > 0.5
    np.testing.assert_allclose(depth[0][inner], depth[1][inner], rtol=1e-4)


def test_buffer_is_float32_and_empty_where_nothing_is(camera, backend):
    ball = trimesh.creation.icosphere(3)
    ball.vertex_normals = ball.vertices
    ball = scene.from_trimesh(ball)
    buffer = scene.gbuffer(ball, camera, **SIZE, backend=backend)
    for name in ("color", "ambient", "diffuse", "specular", "normal", "depth", "roughness"):
        assert getattr(buffer, name).dtype == np.float32
    assert buffer.shader.dtype == np.int32
    depth = scene.depth(ball, camera, **SIZE, backend=backend)
    assert depth.dtype == np.float32
    np.testing.assert_array_equal(depth, buffer.depth)
    nothing = np.isinf(depth)
    assert 0.2 < nothing.mean() < 0.95
    np.testing.assert_array_equal(nothing, np.asarray(buffer.shader) == -1)
    for name in ("color", "ambient", "diffuse", "specular", "normal", "roughness"):
        assert not np.asarray(getattr(buffer, name))[nothing].any()
    ids = scene.object_ids(ball, camera, **SIZE, backend=backend)
    np.testing.assert_array_equal(ids, np.where(nothing, -1, 0))


def test_normals_are_unit_and_face_the_camera(camera, backend, rays):
    """From outside and from inside, with normals that point to either side."""
    _, direction = rays(camera, HEIGHT, WIDTH)
    for radius in (1.5, 40):
        for sign in (1, -1):
            ball = trimesh.creation.icosphere(2, radius=radius)
            ball.vertex_normals = sign * ball.vertices
            buffer = scene.gbuffer(scene.from_trimesh(ball), camera, **SIZE, backend=backend)
            met = np.isfinite(buffer.depth)
            normal = np.asarray(buffer.normal)[met]
            np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1, atol=1e-5)
            assert (np.sum(normal * direction[met], axis=-1) < 1e-5).all()
    assert met.all()


@pytest.mark.parametrize(("offset", "scale"), [(1e6, 1.0), (0.0, 1e-6), (0.0, 1e6)])
def test_far_tiny_and_huge_scenes(backend, offset, scale):
    ball = trimesh.creation.icosphere(3)
    camera = scene.default_camera(scene.from_trimesh(ball), **SIZE)
    expected = in_numpy(scene.depth(scene.from_trimesh(ball), camera, **SIZE, backend=backend))
    ball.apply_transform(np.diag([scale, scale, scale, 1]))
    ball.apply_translation([offset, 0, 0])
    pose = np.array(camera.world_from_camera)
    pose[:3, 3] = pose[:3, 3] * scale + [offset, 0, 0]
    moved = PinholeCamera(camera.intrinsics, pose)
    depth = in_numpy(scene.depth(scene.from_trimesh(ball), moved, **SIZE, backend=backend))
    assert np.mean(np.isinf(depth) == np.isinf(expected)) > 0.999
    both = np.isfinite(depth) & np.isfinite(expected)
    np.testing.assert_allclose(depth[both], expected[both] * scale, rtol=1e-5)


def test_only_what_is_in_front_is_seen(straight, backend):
    """A quad behind the eye hides nothing; of one through the eye, the part in front shows."""
    content = trimesh.Scene()
    for z in (5, 0):
        quad = [[0, 0, z], [4, 0, z], [4, 4, z], [0, 4, z]]
        content.add_geometry(trimesh.Trimesh(quad, [[0, 1, 2], [0, 2, 3]], process=False))
    quads = scene.from_trimesh(content)
    depth = scene.depth(quads, straight(4), height=4, width=4, backend=backend)
    np.testing.assert_allclose(depth, 3)
    corridor = scene.from_trimesh(trimesh.creation.box((2, 2, 40)))
    inside = PinholeCamera.look_at(
        [0, 0, 0.3], [0, 0, -1], up=[0, 1, 0], fov_y=2.0, height=40, width=40
    )
    depth = scene.depth(corridor, inside, height=40, width=40, backend=backend)
    x, y = np.meshgrid(np.arange(40) + 0.5, np.arange(40) + 0.5)
    focal_pixels = np.asarray(inside.intrinsics)[0, 0]
    slope = np.maximum(np.abs(x - 20), np.abs(y - 20)) / focal_pixels
    np.testing.assert_allclose(depth, np.minimum(1 / slope, 20.3), rtol=1e-5)


def test_a_centre_on_an_edge_goes_right_and_down(straight, backend):
    corners = [[2.5, 2.5, 0], [6.5, 2.5, 0], [6.5, 6.5, 0], [2.5, 6.5, 0]]
    quad = scene.from_trimesh(trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False))
    ids = scene.object_ids(quad, straight(9), height=9, width=9, backend=backend)
    expected = np.full((9, 9), -1)
    expected[2:6, 2:6] = 0
    np.testing.assert_array_equal(ids, expected)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 7), (13, 1), (31, 17)])
def test_any_size(backend, height, width):
    ball = scene.from_trimesh(trimesh.creation.icosphere(2))
    camera = PinholeCamera.look_at(
        [0, 0, 3], [0, 0, 0], up=[0, 1, 0], fov_y=0.3, height=height, width=width
    )
    buffer = scene.gbuffer(ball, camera, height=height, width=width, backend=backend)
    assert buffer.color.shape == (height, width, 3)
    middle = np.asarray(buffer.depth)[height // 2, width // 2]
    assert float(middle) == pytest.approx(2, abs=0.1)
