"""Lenses against the formulas of their papers, and finite differences."""

import inspect
import itertools

import hypothesis as hyp
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import (
    FocusPlanes,
    Lens,
    OrthographicCamera,
    PinholeCamera,
    ThinLens,
    depth as depths,
    dof,
)
from tests.helpers.forms import first
from tests.helpers.quick import check_slopes


LENS = ThinLens(0.1, 2.0, 100.0)
PLANES = FocusPlanes(1.0, 2.0, 5.0, 8.0)
METHODS = ("defocus", "circle_of_confusion")


@jax.jit
def circle_of_confusion(lens, depth):
    return lens.circle_of_confusion(depth)


positive = st.floats(0.01, 100)


def potmesil(focal_length, f_number, focus, depth):
    """The 1981 paper's circle of confusion, on the sensor, from its image distances."""
    image_distance = lambda u: focal_length * u / (u - focal_length)
    sensor, image = image_distance(focus), image_distance(depth)
    return abs(image - sensor) * (focal_length / f_number) / image


@hyp.given(positive, positive, positive, positive, positive)
@hyp.settings(max_examples=50, deadline=None)
def test_from_physical_is_the_papers_formula(focal, f_number, beyond, farther, pixels):
    focus, depth = focal + beyond, focal + farther
    lens = ThinLens.from_physical(
        focal_length=focal, f_number=f_number, focus_distance=focus, pixels_per_unit=pixels
    )
    expected = potmesil(focal, f_number, focus, depth) * pixels
    scale = float(lens.aperture) * float(lens.focal_pixels) * max(1 / focus, 1 / depth)
    coc = circle_of_confusion(lens, np.array(depth))
    np.testing.assert_allclose(coc, expected, rtol=1e-9, atol=1e-11 * scale)


def test_a_50_mm_lens_at_f_2():
    """In millimetres: 25 wide, focused at 2 m, seen at 4 m; 100 pixels to the millimetre."""
    arguments = {"focal_length": 50, "focus_distance": 2000, "pixels_per_unit": 100}
    lens = ThinLens.from_physical(f_number=2, **arguments)
    # Image distances 2000 / 39 and 4000 / 79.
    expected = 25 * (1 - (4000 / 79) / (2000 / 39)) / ((4000 / 79) / (2000 / 39)) * 100
    np.testing.assert_allclose(lens.defocus(np.array(4000.0)), expected, rtol=1e-12)
    same = ThinLens.from_physical(aperture=25, **arguments)
    np.testing.assert_allclose(jax.tree.leaves(same), jax.tree.leaves(lens), rtol=1e-12)


def test_from_sensor_is_the_cone_of_rays_through_a_fixed_sensor():
    """A pixel's rays leave a disc of `F / f_number` and meet in the plane in focus."""
    focal_length, f_number, focus, sensor, width = 0.05, 2.8, 2.6, 0.036, 1920
    lens = ThinLens.from_sensor(focal_length, f_number, focus, sensor, width)
    for depth in (0.7, 2.6, 9.0):
        # By similar triangles: the width of the cone there, in the scene, then in pixels.
        across = focal_length / f_number * abs(depth - focus) / focus
        pixels = across / depth * focal_length / sensor * width
        coc = lens.circle_of_confusion(depth)
        np.testing.assert_allclose(coc, pixels, rtol=1e-12, atol=1e-12)
    camera = PinholeCamera.from_blender(
        np.eye(4), lens=focal_length, sensor_width=sensor, height=1080, width=width
    )
    np.testing.assert_allclose(
        lens.focal_pixels, np.asarray(camera.intrinsics)[0, 0], rtol=1e-12
    )


@hyp.given(positive, st.floats(0, 1), positive, st.floats(0, 1))
@hyp.settings(max_examples=30, deadline=None)
def test_from_disparity_is_linear_in_disparity(strength, focus, scale, shift):
    disparity = np.array([[0.0, 0.25, focus, 1.0]])
    lens = ThinLens.from_disparity(
        strength=strength, focus_disparity=focus, scale=scale, shift=shift
    )
    depth = depths.from_disparity(disparity, scale=scale, shift=shift)
    tolerance = 1e-12 * strength * (1 + (1 + shift) / scale)
    np.testing.assert_allclose(
        lens.defocus(depth), strength * (focus - disparity), rtol=0, atol=tolerance
    )
    # And back again.
    found = float(lens.aperture) * float(lens.focal_pixels) * scale
    np.testing.assert_allclose(found, strength, rtol=1e-12)
    back = (1 / float(lens.focus_distance) - shift) / scale
    np.testing.assert_allclose(back, focus, atol=1e-12 * (1 + (1 + shift) / scale))


def test_from_disparity_of_a_lens_at_infinity_and_its_errors():
    lens = ThinLens.from_disparity(strength=6.0, focus_disparity=0.0)
    assert float(lens.focus_distance) == np.inf
    np.testing.assert_allclose(lens.defocus(np.array([np.inf, 2.0])), [0.0, -3.0])
    defocus = lambda strength, focus: ThinLens.from_disparity(
        strength=strength, focus_disparity=focus
    ).defocus(np.array(2.0))
    slopes = jax.jit(jax.grad(defocus, (0, 1)))(6.0, 0.0)
    np.testing.assert_allclose(slopes, [-0.5, 0.0])
    for wrong, named in (
        ({"strength": -1.0}, "strength"),
        ({"scale": 0.0}, "scale"),
        ({"focus_disparity": -0.1}, "focus_disparity"),
        ({"shift": -1.0}, "focus_disparity"),
    ):
        given = {"strength": 6.0, "focus_disparity": 0.5} | wrong
        with pytest.raises(ValueError, match=rf"from_disparity\({named}=...\)"):
            ThinLens.from_disparity(**given)


def test_from_disparity_slopes_through_scatter():
    rng = np.random.default_rng(0)
    image, disparity = rng.random((6, 7, 1)), rng.random((6, 7))

    def loss(disparity, strength, focus):
        lens = ThinLens.from_disparity(strength=strength, focus_disparity=focus)
        depth = depths.from_disparity(disparity, scale=1.0)
        return jnp.sum(dof.scatter(image, depth, lens, max_coc=6.0, program="shift") ** 2)

    check_slopes(
        loss, (disparity + 0.1, np.array(7.0), np.array(0.6)), atol=1e-5, rtol=1e-5, eps=1e-6
    )


@pytest.mark.parametrize(
    ("focus", "share"), [(np.inf, 0), (1e9, 0), (2.6, 0.0196), (0.95, 0.0556)]
)
def test_from_sensor_beside_a_lens_that_moves(focus, share):
    fixed = ThinLens.from_sensor(0.05, 2.8, focus, 0.036, 1920)
    moved = ThinLens.from_physical(
        focal_length=0.05, f_number=2.8, focus_distance=focus, pixels_per_unit=1920 / 0.036
    )
    np.testing.assert_allclose(fixed.aperture, moved.aperture, rtol=1e-12)
    ratio = float(moved.focal_pixels / fixed.focal_pixels)
    assert ratio - 1 == pytest.approx(share, abs=5e-5)


INTEGERS = np.array([[1, 2], [3, 40]])


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("lens", [ThinLens(25.7, 15.5, 525.0), FocusPlanes(0.5, 2.5, 30, 7.3)])
def test_integers_lists_and_other_byte_orders_are_depths(lens, method):
    expected = getattr(lens, method)(INTEGERS.astype(float))
    for given in (INTEGERS, INTEGERS.tolist(), INTEGERS.astype(np.uint16), INTEGERS * 1.0):
        found = getattr(lens, method)(given)
        assert found.dtype == jnp.float64
        np.testing.assert_array_equal(found, expected)
    for kind in (">f4", ">f8", ">u2"):
        found = getattr(lens, method)(INTEGERS.astype(kind))
        np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert getattr(lens, method)(3).shape == ()


@first("method", METHODS)
@pytest.mark.parametrize(
    "lens", [ThinLens(50.0, 2000.0, 1500.0), FocusPlanes(100.0, 2000.0, 60000.0, 7.3)]
)
def test_half_floats_do_not_overflow_inside(lens, method):
    depth = np.float16([500, 2000, 3000, 60000, np.inf])
    found = getattr(lens, method)(depth)
    assert found.dtype == jnp.float16
    exact = np.asarray(getattr(lens, method)(depth.astype(float)))
    np.testing.assert_allclose(np.float64(found), exact, rtol=1e-3, atol=1e-3)


def test_planes_that_end_nowhere():
    """Behind the focus all is sharp: the ramp to inf never begins to rise."""
    planes = FocusPlanes(0.5, 2.0, np.inf, 6.0)
    depth = np.array([0.25, 1.0, 2.0, 3.0, 1e30, np.inf])
    np.testing.assert_allclose(planes.defocus(depth), [-6, -4, 0, 0, 0, 0])
    np.testing.assert_allclose(planes.circle_of_confusion(depth), [6, 4, 0, 0, 0, 0])
    far = FocusPlanes(0.5, 2.0, 1e30, 6.0)
    np.testing.assert_allclose(planes.defocus(depth[:4]), far.defocus(depth[:4]), atol=1e-12)
    for method in METHODS:
        total = lambda lens, depth, method=method: jnp.sum(getattr(lens, method)(depth))
        for mode in (jax.grad, jax.jacfwd):
            slopes = jax.jit(mode(total, (0, 1)))(planes, depth)
            assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))
            assert float(slopes[0].far) == 0
            np.testing.assert_allclose(np.abs(slopes[1]), [0, 4, *[0] * 4], atol=1e-12)
    traced = jax.jit(lambda far: FocusPlanes(0.5, 2.0, far, 6.0).defocus(depth))(jnp.inf)
    np.testing.assert_allclose(traced, [-6, -4, 0, 0, 0, 0])


def test_focus_at_infinity():
    lens = ThinLens(0.1, np.inf, 100.0)
    np.testing.assert_allclose(
        lens.circle_of_confusion(np.array([2.0, 50, np.inf])), [5, 0.2, 0]
    )


@pytest.mark.parametrize("kind", [ThinLens, FocusPlanes])
@pytest.mark.parametrize("method", METHODS)
def test_a_batch_of_lenses_without_vmap(kind, method):
    lens = {ThinLens: LENS, FocusPlanes: PLANES}[kind]
    lenses = jax.tree.map(lambda x: np.stack([x, x, x]), lens)
    message = rf"`{kind.__name__}.{method}` must be one {kind.__name__}, whose .* `jax.vmap`"
    for depth in (np.ones(3), np.ones((2, 3)), 1.0):
        with pytest.raises(ValueError, match=message):
            getattr(lenses, method)(depth)
    batch = jax.vmap(lambda lens: getattr(lens, method)(np.ones((2, 3))))(lenses)
    assert batch.shape == (3, 2, 3)


def test_what_is_a_lens():
    class Own:
        focus_distance = 2.0

        def defocus(self, depth):
            return depth

        def circle_of_confusion(self, depth):
            return depth

    for lens in (LENS, PLANES, Own()):
        assert isinstance(lens, Lens)
    for other in (0.1, None, "lens", np.ones(3), PinholeCamera.from_fov(1, height=1, width=1)):
        assert not isinstance(other, Lens)


def test_thin_lens_formula():
    depth = np.array([[0.5, 1.0, 4.0], [20.0, 1e6, 1e-3]])
    np.testing.assert_allclose(LENS.defocus(depth), 10 * (0.5 - 1 / depth), rtol=1e-12)


def test_thin_lens_from_camera():
    camera = PinholeCamera(np.diag([90.0, 40, 1]), np.eye(4))
    lens = ThinLens.from_camera(camera, aperture=0.2, focus_distance=3)
    np.testing.assert_allclose([*jax.tree.leaves(lens)], [0.2, 3, 60], rtol=1e-15)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("lens", [LENS, PLANES])
def test_special_depths(lens, dtype):
    depth = np.array([1.5, 2, 3, np.inf], dtype)
    defocus = lens.defocus(depth)
    assert defocus.dtype == dtype
    np.testing.assert_array_equal(np.sign(defocus), [-1, 0, 1, 1])
    np.testing.assert_array_equal(lens.circle_of_confusion(depth), np.abs(defocus))
    far = 0.1 * 100 / 2 if lens is LENS else 8
    np.testing.assert_allclose(np.asarray(defocus)[3], far, rtol=1e-6)
    assert lens.focus_distance == 2


def test_depth_zero_and_pinholes():
    zero = np.zeros(())
    assert float(LENS.defocus(zero)) == -np.inf
    assert float(LENS.circle_of_confusion(zero)) == np.inf
    for lens in (ThinLens(0, 2, 100), FocusPlanes(1, 2, 5, 0)):
        depth = np.array([0, 1, 2, 3, np.inf])
        np.testing.assert_array_equal(lens.defocus(depth), 0)
        np.testing.assert_array_equal(lens.circle_of_confusion(depth), 0)


@pytest.mark.parametrize("lens", [LENS, PLANES])
def test_a_nan_depth_stays_one(lens):
    for method in METHODS:
        values = getattr(lens, method)(np.array([np.nan, 3.0]))
        np.testing.assert_array_equal(np.isnan(values), [True, False])


def test_focus_planes_are_piecewise_linear():
    depth = np.array([0.0, 0.5, 1, 1.25, 1.5, 2, 2.75, 3.5, 5, 6, np.inf])
    expected = np.array([-8.0, -8, -8, -6, -4, 0, 2, 4, 8, 8, 8])
    np.testing.assert_allclose(PLANES.defocus(depth), expected, rtol=1e-14, atol=0)
    np.testing.assert_allclose(PLANES.circle_of_confusion(depth), abs(expected), rtol=1e-14)


@pytest.mark.parametrize("method", METHODS)
@first("lens", [LENS, PLANES])
def test_gradients_at_smooth_points(lens, method):
    call = lambda lens, depth: getattr(lens, method)(depth)
    depth = np.array([0.4, 1.3, 1.9, 2.2, 4.1, 7.0])
    check_slopes(call, (lens, depth), rtol=1e-6, eps=1e-4)
    slope = jax.grad(lambda lens: call(lens, depth).sum())
    check_slopes(slope, (lens,), rtol=1e-6, eps=1e-4)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("lens", [LENS, PLANES])
def test_background_passes_a_finite_gradient(lens, method):
    """At infinite depth both modes agree with a depth of 1e15."""
    call = lambda lens, depth: getattr(lens, method)(depth)
    both = [jax.jit(mode(call, argnums=(0, 1))) for mode in (jax.grad, jax.jacfwd)]
    far = both[0](lens, np.array(1e15))
    for slopes in both:
        found = slopes(lens, np.array(jnp.inf))
        np.testing.assert_allclose(
            jax.tree.leaves(found), jax.tree.leaves(far), rtol=1e-12, atol=1e-12
        )


def slope_from(function, x, step):
    """One-sided difference; the sign of `step` is the side."""
    return (float(function(x + step)) - float(function(x))) / step


@first("lens", [LENS, PLANES])
def test_circle_of_confusion_at_its_kink(lens):
    """On the focus plane: the derivative from behind it."""
    for transform in (jax.grad, jax.jacfwd):
        found = jax.jit(transform(lens.circle_of_confusion))(np.array(2.0))
        behind = slope_from(lens.circle_of_confusion, np.array(2.0), 1e-7)
        before = slope_from(lens.circle_of_confusion, np.array(2.0), -1e-7)
        np.testing.assert_allclose(found, behind, rtol=1e-6)
        assert before < 0 < behind


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("depth", "outside"), [(1.0, -1), (5.0, 1)])
def test_focus_planes_at_their_outer_kinks(method, depth, outside):
    """On the near and the far plane: the derivative of the clamped side, zero."""
    call = getattr(PLANES, method)
    assert slope_from(call, np.array(depth), outside * 1e-6) == 0
    assert abs(slope_from(call, np.array(depth), -outside * 1e-6)) > 1
    for transform in (jax.grad, jax.jacfwd):
        assert float(transform(call)(np.array(depth))) == 0


@pytest.mark.parametrize("depth", [1.3, 4.1, np.inf])
@pytest.mark.parametrize("method", METHODS)
def test_a_closed_aperture_can_be_opened(method, depth):
    """At aperture 0, and `max_coc` 0, the gradient is the one-sided slope."""
    thin = lambda aperture: getattr(ThinLens(aperture, 2.0, 100.0), method)(np.array(depth))
    planes = lambda largest: getattr(FocusPlanes(1.0, 2, 5, largest), method)(np.array(depth))
    for call in (thin, planes):
        expected = slope_from(call, 0.0, 1e-3)
        assert abs(expected) > 0.1
        for transform in (jax.grad, jax.jacfwd):
            np.testing.assert_allclose(transform(call)(0.0), expected, rtol=1e-10)


def test_gradients_of_constructors():
    physical = lambda focal, f_number, focus, scale: ThinLens.from_physical(
        focal_length=focal, f_number=f_number, focus_distance=focus, pixels_per_unit=scale
    )
    check_slopes(physical, (0.7, 2.0, 3.0, 20.0), rtol=1e-6, eps=1e-5)
    from_camera = lambda fov: ThinLens.from_camera(
        PinholeCamera.from_fov(fov, height=4, width=4), aperture=0.1, focus_distance=2
    )
    check_slopes(from_camera, (0.7,), rtol=1e-6, eps=1e-5)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("kind", "good", "bad"),
    [
        (
            ThinLens,
            (0.1, 2.0, 100.0),
            [(-0.1, 2, 100), (0.1, 0, 100), (0.1, -2, 100), (0.1, 2, 0)],
        ),
        (FocusPlanes, (1.0, 2.0, 5.0, 8.0), [(2, 2, 5, 8), (1, 5, 5, 8), (1, 2, 5, -1)]),
    ],
)
def test_a_traced_bad_lens_gives_nan(kind, good, bad, method):
    depth = np.array([0.5, 2, 3, np.inf])
    call = jax.jit(lambda numbers: getattr(kind(*numbers), method)(depth))
    assert np.all(np.isfinite(call(np.array(good))))
    for numbers in bad:
        assert np.all(np.isnan(call(np.array(numbers, float))))


@pytest.mark.parametrize("kind", [ThinLens, FocusPlanes])
def test_a_batch_of_lenses(kind):
    rows = np.cumsum(
        np.random.default_rng(0).uniform(1, 2, (4, 3 + (kind is FocusPlanes))), axis=1
    )
    depth = np.linspace(0.5, 9, 7)
    defocus = lambda numbers: kind(*numbers).defocus(depth)
    batch = jax.jit(jax.vmap(defocus))(rows)
    for row, found in zip(rows, np.asarray(batch), strict=True):
        np.testing.assert_allclose(found, defocus(row), rtol=1e-12)


def test_fields_are_strongly_typed():
    for lens in (ThinLens(1, 2, 3), FocusPlanes(1, 2, 3, 4)):
        for leaf in jax.tree.leaves(lens):
            assert leaf.dtype == jnp.float64
            assert not leaf.weak_type


def physical(**changes):
    arguments = {
        "focal_length": 1.0,
        "f_number": 2.0,
        "focus_distance": 3.0,
        "pixels_per_unit": 10.0,
    }
    return ThinLens.from_physical(**(arguments | changes))


def sensor(**changes):
    arguments = {"focal_length": 50, "f_number": 2, "focus_distance": 3000, "sensor_width": 36}
    return ThinLens.from_sensor(**({"width": 640} | arguments | changes))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: ThinLens(-0.1, 2, 3),
            r"`ThinLens\(aperture\)` must be 0 or positive, got -0.1",
        ),
        (lambda: ThinLens(0.1, 0, 3), r"`ThinLens\(focus_distance\)` must be positive, got 0"),
        (lambda: ThinLens(0.1, 2, -3), r"`ThinLens\(focal_pixels\)` must be positive, got -3"),
        (
            lambda: ThinLens([0.1], 2, 3),
            r"`ThinLens\(aperture\)` must have shape \(\), got \(1,\)",
        ),
        (
            lambda: ThinLens(np.nan, 2, 3),
            r"`ThinLens\(aperture\)` must be 0 or positive, got nan",
        ),
        (
            lambda: ThinLens(True, 2, 3),
            r"`ThinLens\(aperture\)` must be a real number, got bool",
        ),
        (
            lambda: ThinLens(1j, 2, 3),
            r"`ThinLens\(aperture\)` must be a real number, got complex",
        ),
        (lambda: physical(aperture=1.0), r"must be given one of the two, got both"),
        (lambda: physical(f_number=None), r"must be given one of the two, got neither"),
        (
            lambda: physical(focus_distance=1.0),
            r"`from_physical\(focus_distance=...\)` must be beyond `focal_length`",
        ),
        (lambda: FocusPlanes(2, 2, 5, 1), r"`FocusPlanes\(near\)` must be before `focus`"),
        (lambda: FocusPlanes(1, 2, 2, 1), r"`FocusPlanes\(far\)` must be behind `focus`"),
        (lambda: FocusPlanes(1, 2, 3, -1), r"`FocusPlanes\(max_coc\)` must be 0 or positive"),
        (lambda: FocusPlanes(1, 2, 3, np.inf), r"`FocusPlanes\(max_coc\)` must be 0 or positi"),
        (
            lambda: FocusPlanes(np.nan, 2, 3, 1),
            r"`FocusPlanes\(near\)` must be finite, got nan",
        ),
        (lambda: FocusPlanes(1, np.inf, np.inf, 1), r"`FocusPlanes\(far\)` must be behind"),
        (lambda: ThinLens(np.inf, 2, 3), r"`ThinLens\(aperture\)` must be 0 or positive, got"),
        (lambda: ThinLens(1, np.nan, 3), r"`ThinLens\(focus_distance\)` must be positive, got"),
        (
            lambda: ThinLens(1, 2, np.inf),
            r"`ThinLens\(focal_pixels\)` must be positive, got inf",
        ),
        (lambda: physical(f_number=0), r"`from_physical\(f_number=...\)` must be positive"),
        (lambda: sensor(f_number=-1), r"`from_sensor\(f_number\)` must be positive, got -1"),
        (lambda: sensor(width=-2), r"`from_sensor\(width\)` must be a positive integer"),
        # Blender's distance is in metres, its other lengths are in millimetres.
        (
            lambda: sensor(focus_distance=2.6),
            r"`from_sensor\(focus_distance\)` must be beyond `focal_length`, both in one unit",
        ),
        *(
            (lambda factor=factor: sensor(sensor_width=36 * factor), r"unit of `focal_length`")
            for factor in (1e3, 1e-3)
        ),
    ],
)
def test_errors(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_a_lens_on_a_camera_of_another_kind():
    make = inspect.unwrap(ThinLens.from_camera.__func__)
    camera = OrthographicCamera(1, [0, 0], np.eye(4))
    with pytest.raises(ValueError, match=r"`from_camera\(camera\)` must be a PinholeCamera"):
        make(ThinLens, camera, aperture=1, focus_distance=2)


def test_the_three_numbers_are_all_that_an_image_knows():
    """Lenses that differ in their physical numbers only give one defocus."""
    depth = np.linspace(1.2, 9, 20)
    for focal, scale in itertools.product((0.5, 1.0), (10.0, 30.0)):
        lens = physical(focal_length=focal, pixels_per_unit=scale)
        image_distance = focal * 3 / (3 - focal)
        same = ThinLens(focal / 2, 3.0, image_distance * scale)
        np.testing.assert_allclose(
            lens.defocus(depth), same.defocus(depth), rtol=1e-12, atol=1e-12
        )


def test_a_lens_prints_its_numbers_and_a_traced_one_its_types():
    lens = ThinLens(0.1, 2.0, 100.0)
    assert repr(lens) == "ThinLens(aperture=0.1, focus_distance=2, focal_pixels=100)"
    assert repr(FocusPlanes(1.0, 2.0, 4.0, 8.0)).endswith("(near=1, focus=2, far=4, max_coc=8)")
    texts = []
    jax.jit(lambda lens: texts.append(repr(lens)))(lens)
    jax.vmap(lambda lens: texts.append(repr(lens)))(jax.tree.map(jnp.atleast_1d, lens))
    assert all(text.startswith("ThinLens(aperture=") and "[]" in text for text in texts)
    assert "[1]" in repr(jax.tree.map(jnp.atleast_1d, lens))
