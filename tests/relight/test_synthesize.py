"""New views against a plain loop and against fresh caches. (Where two surfaces might blend:
`tests/stability`.)"""

import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import GBuffer, OrthographicCamera, PinholeCamera, metrics, relight, scene
from tests.cases.relight_views import (
    BLUE,
    CAMERAS,
    FRONTAL,
    HEIGHT,
    LARGE,
    RED,
    SIZE,
    TARGET,
    WIDTH,
    cache,
    orbit,
    pinhole,
    plane,
    points,
)
from tests.helpers.forms import first


FLOATS = ("color", "ambient", "diffuse", "specular", "roughness", "normal")


def loop(gbuffers, cameras, target, depth, field, tolerance):
    """Equations 2 and 3, pixel by pixel, gated by the distance along the ray alone."""
    image, views = np.zeros((*depth.shape, 3)), np.zeros(depth.shape, int)

    def split(camera):
        pose = np.asarray(camera.world_from_camera, float)
        return np.asarray(camera.intrinsics, float), pose[:3, :3], pose[:3, 3]

    intrinsics, turn, eye = split(target)
    for j, i in np.ndindex(depth.shape):
        ray = np.linalg.inv(intrinsics) @ [i + 0.5, j + 0.5, 1]
        position = turn @ (ray * depth[j, i]) + eye
        values = []
        for gbuffer, camera in zip(gbuffers, cameras, strict=True):
            k, r, t = split(camera)
            x, y, z = k @ r.T @ (position - t)
            column, row = int(np.floor(x / z)), int(np.floor(y / z))
            if z <= 0 or not (0 <= row < HEIGHT and 0 <= column < WIDTH):
                continue
            if abs(np.asarray(gbuffer.depth)[row, column] - z) <= tolerance * z:
                values.append(np.asarray(getattr(gbuffer, field))[row, column])
        views[j, i] = len(values)
        image[j, i] = np.mean(values, axis=0) if values else 0
    return image, views


def test_the_same_camera_gives_the_same_cache():
    camera = orbit(0)
    gbuffer = cache(camera)
    found, views = relight.synthesize([gbuffer], [camera], camera, depth=gbuffer.depth)
    np.testing.assert_array_equal(views, np.isfinite(gbuffer.depth))
    for name in (*FLOATS, "shader", "depth"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(gbuffer, name), rtol=1e-6, atol=1e-6, err_msg=name
        )
        assert getattr(found, name).dtype == getattr(gbuffer, name).dtype


def test_equals_the_loop_over_pixels():
    """On a plane that faces the cameras more or less, where the tests agree."""
    gbuffers = [FRONTAL(camera) for camera in CAMERAS]
    depth = np.asarray(FRONTAL(TARGET).depth)
    found, views = relight.synthesize(gbuffers, CAMERAS, TARGET, depth=depth, tolerance=0.03)
    image, expected = loop(gbuffers, CAMERAS, TARGET, depth, "diffuse", 0.03)
    assert {2, 3} <= set(np.unique(expected))
    np.testing.assert_array_equal(views, expected)
    np.testing.assert_allclose(found.diffuse, image, rtol=1e-12)


def test_caches_of_other_sizes_and_cameras():
    """An orthographic cache of another size, of a plane of one colour."""
    size = (40, 20)
    camera = OrthographicCamera(15.0, [10, 20], np.eye(4))
    gbuffer = plane([0.3, 0, -1], size=size)(camera, color=0.6)
    depth = plane([0.3, 0, -1])(TARGET).depth
    found, views = relight.synthesize([gbuffer], [camera], TARGET, depth=depth)
    pixels, _ = camera.project(points(TARGET, depth))
    x, y = np.moveaxis(np.asarray(pixels), -1, 0)
    inside = (x >= 0) & (x < 20) & (y >= 0) & (y < 40)
    assert 0 < inside.sum() < inside.size
    np.testing.assert_array_equal(views, inside)
    expected = np.broadcast_to(np.where(inside, 0.6, 0)[..., None], (*SIZE, 3))
    np.testing.assert_allclose(found.color, expected)


def test_an_oblique_plane_is_seen_whole_although_its_depth_is_steep():
    """80 degrees off: within a pixel the depth changes by 20 tolerances and more."""
    steep, tolerance = plane([0, -np.sin(1.4), -np.cos(1.4)]), 1e-3
    camera = pinhole(-0.39)
    depth = np.asarray(steep(camera).depth)
    near = depth < 3.5
    with np.errstate(invalid="ignore"):
        rise = np.abs(np.diff(depth, axis=0, append=np.nan)) / depth
    assert np.nanmax(rise[near]) > 20 * tolerance
    caches = [steep(CAMERAS[0])], [CAMERAS[0]]
    _, views = relight.synthesize(*caches, camera, depth=depth, tolerance=tolerance)
    assert (np.asarray(views) > 0)[near].mean() > 0.9


# --- Surfaces that differ.


def test_ids_are_never_averaged():
    """Shaders 0 and 2 of one surface: the answer is either, never 1."""
    gbuffers = [plane([0, 0, -1], shader=s)(c) for s, c in zip((0, 2, 2), CAMERAS, strict=True)]
    found, _ = relight.synthesize(gbuffers, CAMERAS, TARGET, depth=FRONTAL(TARGET).depth)
    assert set(np.unique(found.shader)) <= {-1, 0, 2}


def test_normals_are_averaged_on_the_sphere():
    one, other = np.array([0.3, 0, -1]), np.array([-0.1, 0.2, -1])
    bent = []
    for camera, normal in zip(CAMERAS, (one, other, other), strict=True):
        unit = normal / np.linalg.norm(normal)
        image = np.broadcast_to(unit, (*SIZE, 3))
        bent.append(eqx.tree_at(lambda g: g.normal, FRONTAL(camera), image))
    found, views = relight.synthesize(
        bent, CAMERAS, TARGET, depth=FRONTAL(TARGET).depth, tolerance=0.1, angle=0.6
    )
    total = one / np.linalg.norm(one) + 2 * other / np.linalg.norm(other)
    full = np.asarray(views) == 3
    assert full.any()
    np.testing.assert_allclose(
        np.asarray(found.normal)[full] - total / np.linalg.norm(total), 0, atol=1e-12
    )


def test_zero_normals_are_gated_by_depth_alone():
    bare = [eqx.tree_at(lambda g: g.normal, FRONTAL(c), np.zeros((*SIZE, 3))) for c in CAMERAS]
    depth = FRONTAL(TARGET).depth
    found, views = relight.synthesize(bare, CAMERAS, TARGET, depth=depth, tolerance=0.03)
    _, expected = relight.synthesize(
        [FRONTAL(c) for c in CAMERAS], CAMERAS, TARGET, depth=depth, tolerance=0.03
    )
    assert ((np.asarray(views) > 0) == (np.asarray(expected) > 0)).all()
    assert np.isfinite(found.color).all() and not np.asarray(found.normal).any()


@pytest.mark.parametrize("name", ["color", "normal", "depth", "roughness"])
def test_a_bad_pixel_of_a_cache_reaches_only_those_that_read_it(name):
    gbuffers = [FRONTAL(camera) for camera in CAMERAS]
    depth = FRONTAL(TARGET).depth
    good, _ = relight.synthesize(gbuffers, CAMERAS, TARGET, depth=depth)
    image = np.array(getattr(gbuffers[1], name))
    image[12, 15] = np.nan
    gbuffers[1] = eqx.tree_at(lambda g: getattr(g, name), gbuffers[1], image)
    bad, _ = relight.synthesize(gbuffers, CAMERAS, TARGET, depth=depth)
    # A cache that is bad there is left out, but where its colours are.
    differs = lambda field: np.asarray(getattr(good, field)) != np.asarray(getattr(bad, field))
    changed = differs("color").any(-1) | differs("roughness")
    assert 1 <= changed.sum() <= 4
    kept = jax.tree.map(lambda image: np.asarray(image)[~changed], bad)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(kept))
    if name in ("normal", "depth"):
        assert np.isfinite(bad.color).all()


@pytest.mark.parametrize("name", ["color", "normal", "depth"])
@pytest.mark.full
def test_a_bad_pixel_of_a_cache_spoils_no_derivative_of_the_cameras(name):
    """Where another cache has the point: by detail, the weights follow the cameras."""
    gbuffers = [FRONTAL(camera) for camera in CAMERAS]
    bad = getattr(gbuffers[1], name).at[5:20, 8:25].set(jnp.nan)
    gbuffers[1] = eqx.tree_at(lambda g: getattr(g, name), gbuffers[1], bad)
    if name == "color":  # and not seen: another surface
        gbuffers[1] = eqx.tree_at(lambda g: g.depth, gbuffers[1], 2 * gbuffers[1].depth)
    depth = FRONTAL(TARGET).depth

    def color(cameras, target):
        options = {"depth": depth, "weighting": "detail", "tolerance": 0.03}
        return relight.synthesize(gbuffers, cameras, target, **options)[0].color

    @jax.jit
    def derivatives(cameras, target):
        value, pull = jax.vjp(color, cameras, target)
        return value, pull(jnp.ones_like(value)), jax.jvp(color, *[(cameras, target)] * 2)[1]

    for path, leaf in jax.tree_util.tree_leaves_with_path(derivatives(CAMERAS, TARGET)):
        assert np.isfinite(leaf).all(), jax.tree_util.keystr(path)


@pytest.mark.parametrize("missing", [0.0, -1.0, np.nan])
def test_what_is_missing_in_a_depth_is_no_hole_to_fill(missing):
    """In the new view as background; in a cache, as where it shows nothing."""
    gbuffers, depth = [FRONTAL(camera) for camera in CAMERAS], FRONTAL(TARGET).depth
    lost = np.zeros(depth.shape, bool)
    lost[4:9, 5:12] = True
    found, covered = [], []
    for nothing in (np.inf, missing):
        cached = np.where(lost, nothing, gbuffers[0].depth)
        holed = eqx.tree_at(lambda g: g.depth, gbuffers[0], cached)
        given = np.where(lost, nothing, depth)
        buffer, views = relight.synthesize([holed], CAMERAS[:1], TARGET, depth=given)
        covered.append((views, relight.fill_holes(buffer, views)[1]))
        found.append(relight.fill_holes(buffer, views)[0])
    np.testing.assert_array_equal(covered[1][0], covered[0][0])
    assert int(covered[1][1]) == int(covered[0][1]) > 0
    for name in (*FLOATS, "shader"):
        np.testing.assert_array_equal(*(getattr(each, name) for each in found))


@pytest.mark.parametrize("scale", [1e-6, 1e10, 1e20, 1e36])
def test_a_scene_of_any_scale_gives_the_same_view(scale):
    """In float32: positions and depths alike, and what is made of two caches by detail."""

    def eye(x, scale):
        pose = np.eye(4, dtype=np.float32)
        pose[0, 3] = x * scale
        return PinholeCamera.from_fov(0.8, height=8, width=10, world_from_camera=pose)

    color = np.random.default_rng(0).random((8, 10, 3)).astype(np.float32)
    facing = np.broadcast_to(np.float32([0, 0, -1]), color.shape)
    found = []
    for size in (1.0, scale):
        depth = np.full((8, 10), 4 * size, np.float32)
        images = color, np.zeros((8, 10), int), color, color, color, facing, depth
        gbuffer = GBuffer(*images, np.full((8, 10), 0.5, np.float32))
        eyes = eye(0, size), eye(0.4, size)
        options = {"depth": depth, "weighting": "detail", "tolerance": 0.02}
        found.append(relight.synthesize([gbuffer] * 2, eyes, eye(0.1, size), **options))
    (one, views), (other, same) = found
    np.testing.assert_array_equal(same, views)
    np.testing.assert_allclose(other.color, one.color, atol=1e-6)


@pytest.mark.full
def test_detail_favours_the_camera_that_is_nearer():
    near = PinholeCamera.look_at(
        [0, 0, 2], [0, 0, 3], up=[0, -1, 0], fov_y=0.7, height=HEIGHT, width=WIDTH
    )
    cameras = [CAMERAS[1], near]
    gbuffers = [FRONTAL(cameras[0], color=RED), FRONTAL(near, color=BLUE)]
    depth = FRONTAL(TARGET).depth
    red = {
        weighting: relight.synthesize(
            gbuffers, cameras, TARGET, depth=depth, weighting=weighting, tolerance=0.1
        )
        for weighting in ("equal", "detail")
    }
    both = np.asarray(red["equal"][1]) == 2
    assert both.any()
    np.testing.assert_allclose(np.asarray(red["equal"][0].color)[both][:, 0], 0.5)
    # The pixels of each on a unit of the plane: 1 / depth**2, times the cosine.
    far = np.linalg.norm([0.3, 0.2, 3])
    expected = 3 / far / far**2 / (3 / far / far**2 + 1)
    middle = both & (np.abs(points(TARGET, depth) - [0, 0, 3]).max(-1) < 0.05)
    assert middle.any()
    np.testing.assert_allclose(
        (np.asarray(red["detail"][0].color)[middle][:, 0] - 0.1) / 0.8, expected, rtol=0.05
    )


# --- Derivatives.


@pytest.mark.parametrize("weighting", ["equal", "detail"])
@pytest.mark.full
def test_derivatives_in_the_caches_and_cameras(weighting):
    """Forward, reverse and differences: in float64 the steps move no point to another pixel."""
    tilted = plane([0.1, 0.2, -1])
    gbuffers = [tilted(camera) for camera in CAMERAS[:2]]
    floats, others = eqx.partition(gbuffers, eqx.is_inexact_array)
    arguments = floats, CAMERAS[:2], TARGET, tilted(TARGET).depth
    along = jax.tree.map(lambda leaf: jnp.cos(7 * leaf), arguments)

    def loss(floats, cameras, target, depth):
        gbuffers = eqx.combine(floats, others)
        found, _ = relight.synthesize(
            gbuffers, cameras, target, depth=depth, weighting=weighting, tolerance=0.05
        )
        images = eqx.filter(found, eqx.is_inexact_array)
        return sum(jnp.sum(jnp.sin(leaf)) for leaf in jax.tree.leaves(images))

    @jax.jit
    def derivatives(arguments, along):
        pushed = jax.jvp(loss, arguments, along)[1]
        return pushed, jax.grad(loss, argnums=(0, 1, 2, 3))(*arguments)

    pushed, pulled = derivatives(arguments, along)
    value = jax.jit(lambda h: loss(*jax.tree.map(lambda x, v: x + h * v, arguments, along)))
    quotient = float(value(1e-7) - value(-1e-7)) / 2e-7
    assert float(pushed) == pytest.approx(quotient, rel=1e-5)
    pairs = zip(jax.tree.leaves(pulled), jax.tree.leaves(along), strict=True)
    assert float(pushed) == pytest.approx(float(sum(jnp.vdot(*p) for p in pairs)), rel=1e-9)


def psnr(image, reference, mask=None):
    return float(metrics.psnr(image, reference, mask=mask))


def new_view(caches, count, degrees):
    gbuffers, cameras = (each[:count] for each in caches)
    target = orbit(degrees, 0.1, LARGE)
    truth = cache(target, LARGE)
    found, views = relight.synthesize(gbuffers, cameras, target, depth=truth.depth)
    return target, truth, found, np.asarray(views)


@first("degrees", [5, 15, 30])
@pytest.mark.full
def test_more_caches_leave_fewer_holes_and_are_right_outside(caches, degrees):
    """PSNR of every parameter, ids exact, and the relit image, filled and outside holes."""
    shares = []
    for count in (1, 2, 4, 8):
        target, truth, found, views = new_view(caches, count, degrees)
        shown = np.asarray(truth.shader) >= 0
        seen = views > 0
        assert not seen[~shown].any() and views.max() <= count
        shares.append(seen[shown].mean())
        assert set(np.unique(found.shader)) <= {-1, 0, 2}
        wrong = np.asarray(found.shader != truth.shader)[seen]
        assert wrong.mean() < 0.005
        for name in ("color", "diffuse", "specular", "normal"):
            assert psnr(getattr(found, name), getattr(truth, name), seen) > 18, name
        np.testing.assert_array_equal(found.depth, truth.depth)
        length = np.linalg.norm(np.asarray(found.normal), axis=-1)
        np.testing.assert_allclose(length, seen, atol=1e-5)

        filled, holes = relight.fill_holes(found, views)
        assert int(holes) == (shown & ~seen).sum()
        assert (np.asarray(filled.shader)[shown] >= 0).all()
        lights = scene.default_lights(target)
        images = [relight.render(each, target, lights) for each in (truth, found, filled)]
        assert psnr(images[2], images[0]) >= psnr(images[1], images[0])
        assert psnr(images[1], images[0], seen) > 20
    assert shares == sorted(shares) and shares[0] > 0.4
    assert shares[-1] > {5: 0.98, 15: 0.95, 30: 0.8}[degrees]


@pytest.mark.parametrize("missing", [0.0, -2.0, np.nan])
def test_a_missing_depth_is_nothing_and_stays_so(missing):
    gbuffer = FRONTAL(TARGET)
    depth = np.array(gbuffer.depth)
    depth[1, 2] = missing
    found, views = relight.synthesize([gbuffer], [TARGET], TARGET, depth=depth)
    full, covered = relight.synthesize([gbuffer], [TARGET], TARGET, depth=gbuffer.depth)
    assert np.asarray(covered)[1, 2] == 1
    there = np.ones(depth.shape, bool)
    there[1, 2] = False
    np.testing.assert_array_equal(views, np.where(there, covered, 0))
    assert np.asarray(found.shader)[1, 2] == -1
    np.testing.assert_array_equal(np.asarray(found.color)[there], np.asarray(full.color)[there])
    filled, count = relight.fill_holes(found, views)
    assert int(count) == 0
    assert np.asarray(filled.shader)[1, 2] == -1


def test_errors_name_the_argument():
    synthesize = inspect.unwrap(relight.synthesize)
    gbuffer, depth = FRONTAL(TARGET), np.asarray(FRONTAL(TARGET).depth)
    with pytest.raises(ValueError, match=r"`synthesize\(gbuffers\)` must be a sequence of at"):
        synthesize([], [], TARGET, depth=depth)
    with pytest.raises(ValueError, match=r"`synthesize\(gbuffers\)` must be a sequence"):
        synthesize(gbuffer, TARGET, TARGET, depth=depth)
    with pytest.raises(ValueError, match=r"`synthesize\(cameras\)` must be one for each cache"):
        synthesize([gbuffer], CAMERAS, TARGET, depth=depth)
    with pytest.raises(ValueError, match=r"`synthesize\(depth=...\)` must have shape"):
        synthesize([gbuffer], [TARGET], TARGET, depth=depth[0])
    for name, value in (("tolerance", 0.0), ("angle", -1.0)):
        with pytest.raises(ValueError, match=rf"`synthesize\({name}=...\)` must be positive"):
            synthesize([gbuffer], [TARGET], TARGET, depth=depth, **{name: value})
