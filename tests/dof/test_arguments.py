"""What all methods do alike: missing depths, lenses of one's own, arguments of other kinds."""

import functools as ft
import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import FocusPlanes, ThinLens, dof
from tests.helpers.forms import first


SIZE = (14, 16)
LENS = ThinLens(0.2, 2.0, 60.0)  # circles of up to 6 pixels
MAX_COC = 6.0
HOLE = (6, 7)
MISSING = [0.0, -0.0, -3.0, -np.inf, np.nan]

METHODS = {
    **{
        f"scatter {program}": ft.partial(dof.scatter, program=program, gamma=0.5)
        for program in ("segment_sum", "shift", "tiles", "spans", "rows")
    },
    "layered": dof.layered,
    "depth_sorted": dof.depth_sorted,
    "depth_sorted all": ft.partial(dof.depth_sorted, slices="all"),
    "gather": dof.gather,
    "gather 13": ft.partial(dof.gather, taps=13, ramp=0.5),
    "blend": dof.blend,
    "separable": dof.separable,
    "anisotropic_diffusion": dof.anisotropic_diffusion,
    "implicit_diffusion": dof.implicit_diffusion,
}
# All programs of a function read their arguments in one place: the quick form takes one.
SUMS = {f"scatter {program}" for program in ("shift", "tiles", "spans", "rows")}
PROGRAMS = SUMS | {"depth_sorted all", "gather 13"}
EACH = [
    pytest.param(name, marks=pytest.mark.full if name in PROGRAMS else ()) for name in METHODS
]
# In these a pixel without a circle shows what reaches it; in the others its own colour.
SPREADING = {name for name in METHODS if name.split()[0] in ("scatter", "layered", "separable")}
SPREADING |= {"depth_sorted", "depth_sorted all"}
# No method reads farther: gather's low-resolution image.
FAR = 0.8 * MAX_COC + 10


def blurred(name):
    """A method as a function of image, depth and lens."""
    return ft.partial(METHODS[name], max_coc=MAX_COC)


@ft.cache
def drawn(name):
    """The same, compiled."""
    return jax.jit(blurred(name))


def scene(seed=0, size=SIZE):
    """A wall and a nearer half of it, both slanted."""
    rng = np.random.default_rng(seed)
    depth = np.where(np.arange(size[1]) < size[1] // 2, 1.2, 5.0) + rng.uniform(0, 0.2, size)
    return rng.uniform(0.2, 1, (*size, 3)), depth


def with_hole(value=np.nan, color=None, at=HOLE):
    image, depth = scene()
    depth[at] = value
    if color is not None:
        image[at] = color
    return image, depth


OTHERS = np.ones(SIZE, bool)
OTHERS[HOLE] = False


@pytest.mark.parametrize("name", EACH)
def test_every_missing_depth_is_the_same(name):
    first, *others = (np.asarray(drawn(name)(*with_hole(value), LENS)) for value in MISSING)
    assert np.isfinite(first).all()
    for other in others:
        np.testing.assert_array_equal(other, first)
    concrete = METHODS[name](*with_hole(0.0), LENS, max_coc=MAX_COC)
    np.testing.assert_allclose(concrete, first, rtol=1e-9)


@pytest.mark.parametrize("name", EACH)
def test_a_missing_pixel_has_no_share_in_others(name):
    plain = np.asarray(drawn(name)(*with_hole(), LENS))
    bright = np.asarray(drawn(name)(*with_hole(color=1e4), LENS))
    np.testing.assert_allclose(bright[OTHERS], plain[OTHERS], rtol=1e-9)
    # Without a colour of its own it is no number, and no other pixel is any the worse.
    lost = np.asarray(drawn(name)(*with_hole(color=np.nan), LENS))
    np.testing.assert_array_equal(np.isnan(lost).any(axis=-1), ~OTHERS)
    np.testing.assert_allclose(lost[OTHERS], plain[OTHERS], rtol=1e-9)


@first("name", METHODS)
def test_the_effect_of_a_hole_is_local(name):
    size = (40, 44)
    image, depth = scene(size=size)
    holed = depth.copy()
    holed[20, 21] = 0
    before, after = (np.asarray(drawn(name)(image, d, LENS)) for d in (depth, holed))
    distance = np.hypot(*(np.indices(size) - np.array([20, 21])[:, None, None]))
    moved = np.abs(after - before).max(axis=-1)
    if "diffusion" in name:
        assert moved[distance > 3 * MAX_COC].max() < 1e-3  # Heat has no last pixel.
    else:
        assert moved[distance > np.sqrt(2) * FAR].max() < 1e-12


@pytest.mark.parametrize("name", EACH)
@pytest.mark.parametrize("depth", [1.2, 6.0])
def test_a_hole_in_an_even_picture(name, depth):
    """All is of one colour and one depth out of focus, but for one pixel that has none."""
    image, depths = np.full((*SIZE, 3), 0.25), np.full(SIZE, depth)
    image[HOLE], depths[HOLE] = 0.75, 0
    found = np.asarray(drawn(name)(image, depths, LENS))
    np.testing.assert_allclose(found[OTHERS], 0.25, rtol=1e-6)
    own = 0.25 if name in SPREADING else 0.75
    np.testing.assert_allclose(found[HOLE], own, atol=2e-3)


@pytest.mark.parametrize("name", EACH)
def test_a_hole_that_nothing_reaches_keeps_its_colour(name):
    image, depth = scene()
    depth[:] = LENS.focus_distance
    depth[3:6, 4:8] = np.nan
    np.testing.assert_allclose(drawn(name)(image, depth, LENS), image, rtol=1e-9)
    nothing = np.zeros(SIZE)
    np.testing.assert_allclose(drawn(name)(image, nothing, LENS), image, rtol=1e-9)


def test_scatter_of_holes_is_the_mean_of_all_others():
    """The docstring's mean, written out: a disc has in each row its exact area."""
    image, depth = with_hole(at=(slice(5, 8), slice(6, 8)))
    missing = ~(depth > 0)
    coc = np.abs(0.2 * 60 * (1 / 2.0 - 1 / np.where(missing, 2.0, depth)))
    along = (np.arange(4000) + 0.5) / 4000 - 0.5
    sums = np.zeros((*SIZE, 4))
    for p in map(tuple, np.argwhere(~missing)):
        radius = max(coc[p] / 2, 0.5)
        for q in np.ndindex(SIZE):
            row, column = abs(q[0] - p[0]), abs(q[1] - p[1])
            half = np.mean(np.sqrt(np.maximum(radius**2 - (row + along) ** 2, 0)))
            cover = np.clip(0.5 - column + half, 0, 1) - np.clip(0.5 - column - half, 0, 1)
            weight = cover / (np.pi * radius**2)
            if depth[p] < 2.0:
                weight *= (2.0 / depth[p]) ** 0.5
            elif not missing[q]:
                sharp = 1 - np.clip(coc[q] / 2 - 1, 0, 1)
                weight *= 1 - sharp * np.clip((coc[p] - coc[q]) / 2, 0, 1)
            sums[q] += weight * np.append(image[p], 1)
    sums[missing] += 1e-3 * np.append(image, np.ones((*SIZE, 1)), axis=-1)[missing]
    expected = sums[..., :3] / sums[..., 3:]
    np.testing.assert_allclose(drawn("scatter shift")(image, depth, LENS), expected, atol=1e-4)


@pytest.mark.parametrize("program", ["shift", "tiles", "spans", "rows"])
@pytest.mark.full
def test_kernels_of_scatter_agree_about_holes(program):
    image, depth = scene(3, (30, 34))
    depth[np.random.default_rng(4).random(depth.shape) < 0.2] = 0
    depth[8:16, 10:22] = np.nan
    planes = FocusPlanes(0.5, 2.0, 9.0, 5.0)
    for lens in (LENS, planes):
        expected = drawn("scatter segment_sum")(image, depth, lens)
        found = drawn(f"scatter {program}")(image, depth, lens)
        np.testing.assert_allclose(found, expected, rtol=1e-6)


@first("name", METHODS)
@first("value", [0.0, np.nan])
def test_derivatives_beside_a_hole(name, value):
    """Forward and reverse against differences; nothing passes through a missing depth."""
    image, depth = with_hole(value)
    weight = np.random.default_rng(5).normal(size=(*SIZE, 3))
    loss = lambda image, depth, lens: jnp.sum(weight * blurred(name)(image, depth, lens))
    by_image, by_depth, by_lens = jax.jit(jax.grad(loss, (0, 1, 2)))(image, depth, LENS)
    leaves = jax.tree.leaves((by_image, by_depth, by_lens))
    assert all(np.isfinite(leaf).all() for leaf in leaves)
    assert np.asarray(by_depth)[HOLE] == 0
    rng = np.random.default_rng(6)
    along = tuple(rng.normal(size=x.shape) for x in (image, depth))
    along[1][HOLE] = 0  # 0 is the last of what is missing.
    lens = jax.device_get(LENS)
    along = (*along, jax.tree.map(lambda x: rng.normal() * x, lens))
    dot = lambda a, b: sum(
        float(np.vdot(x, y))
        for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )
    reverse = dot((by_image, by_depth, by_lens), along)
    arguments = (image, depth, lens)
    _, forward = jax.jit(lambda x, v: jax.jvp(loss, x, v))(arguments, along)
    assert float(forward) == pytest.approx(reverse, rel=1e-8)

    def moved(step):
        image, depth, lens = jax.tree.map(lambda x, v: x + step * v, arguments, along)
        return np.sum(weight * np.asarray(drawn(name)(image, depth, lens)))

    quotient = (moved(1e-6) - moved(-1e-6)) / 2e-6
    assert float(forward) == pytest.approx(quotient, rel=1e-4, abs=1e-4)


@first("name", METHODS)
def test_a_batch_with_a_hole_in_one(name):
    (one, clear), (other, holed) = scene(), with_hole(0.0)
    images, depths = np.stack([one, other]), np.stack([clear, holed])
    batch = jax.jit(jax.vmap(blurred(name), (0, 0, None)))(images, depths, LENS)
    for i in (0, 1):
        np.testing.assert_allclose(batch[i], drawn(name)(images[i], depths[i], LENS), rtol=1e-8)


@pytest.mark.full
def test_the_second_layer_may_have_holes():
    image, depth = scene()
    behind = np.full((*SIZE, 3), 0.5), np.full(SIZE, 7.0)
    call = jax.jit(
        lambda depth, image2, depth2: dof.layered(
            image, depth, LENS, behind=(image2, depth2), max_coc=MAX_COC
        )
    )
    none = behind[1].copy()
    none[4:9, 5:9] = np.inf
    expected = call(depth, behind[0], none)
    for value in MISSING:
        holed = np.where(np.isinf(none), value, none)
        np.testing.assert_allclose(call(depth, behind[0], holed), expected, rtol=1e-10)
    # And where the first layer is missing, the second is hidden by nobody knows what.
    first = depth.copy()
    first[HOLE] = np.nan
    bright = behind[0].copy()
    bright[HOLE] = 1e3
    found = call(first, bright, behind[1])
    np.testing.assert_allclose(found, call(first, *behind), rtol=1e-9)


class Own(eqx.Module):
    """A lens of one's own, by the formula of a thin one."""

    aperture: jax.Array
    focus: jax.Array

    @property
    def focus_distance(self):
        return self.focus

    def defocus(self, depth):
        return self.aperture * 60.0 * (1 / self.focus - 1 / depth)

    def circle_of_confusion(self, depth):
        difference = 1 / self.focus - 1 / depth
        return self.aperture * 60.0 * jnp.where(difference < 0, -difference, difference)


class Plain:
    """The same as an object that JAX knows nothing of, with a number that is none of its."""

    def __init__(self, lens):
        self.lens, self.focus_distance = lens, float(lens.focus_distance)

    def defocus(self, depth):
        return np.asarray(self.lens.defocus(np.asarray(depth)), np.float32)

    def circle_of_confusion(self, depth):
        return np.abs(self.defocus(depth))


@first("name", METHODS)
@pytest.mark.full
def test_a_lens_of_ones_own(name):
    """Like the thin lens whose formula it has, in value and in every derivative."""
    image, depth = (jnp.asarray(x) for x in with_hole())
    own = Own(jnp.array(0.2), jnp.array(2.0))
    expected = drawn(name)(image, depth, LENS)
    np.testing.assert_allclose(drawn(name)(image, depth, own), expected, rtol=1e-9)
    left_out = METHODS[name](image, depth, own)  # max_coc
    np.testing.assert_allclose(left_out, METHODS[name](image, depth, LENS), rtol=1e-9)
    weight = jnp.asarray(np.random.default_rng(7).normal(size=(*SIZE, 3)))
    loss = lambda depth, lens: jnp.sum(weight * blurred(name)(image, depth, lens))
    by_depth, by_lens = jax.jit(jax.grad(loss, (0, 1)))(depth, LENS)
    own_depth, by_own = jax.jit(jax.grad(loss, (0, 1)))(depth, own)
    np.testing.assert_allclose(own_depth, by_depth, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(by_own.aperture, by_lens.aperture, rtol=1e-8)
    np.testing.assert_allclose(by_own.focus, by_lens.focus_distance, rtol=1e-7)
    ones = Own(jnp.ones(()), jnp.ones(()))
    push = jax.jit(lambda own: jax.jvp(lambda lens: loss(depth, lens), (own,), (ones,))[1])
    forward = push(own)
    assert float(forward) == pytest.approx(float(by_own.aperture + by_own.focus), rel=1e-7)


@first("name", METHODS)
def test_any_object_is_a_lens(name):
    image, depth = with_hole(0.0)
    plain = Plain(LENS)
    call = lambda: np.asarray(METHODS[name](image, depth, plain, max_coc=MAX_COC))
    np.testing.assert_allclose(
        call(), METHODS[name](image, depth, LENS, max_coc=MAX_COC), rtol=2e-5
    )
    first = call()
    plain.lens = ThinLens(0.05, 2.0, 60.0)  # It is asked at every call.
    assert np.abs(call() - first).max() > 1e-3


def test_a_lens_that_hides_what_is_traced_asks_for_max_coc():
    image, depth = scene()

    @jax.jit
    def blurred(aperture):
        lens = Plain(LENS)
        lens.defocus = lambda depth: aperture * (1 / 2.0 - 1 / depth)
        lens.circle_of_confusion = lambda depth: jnp.abs(lens.defocus(depth))
        return dof.scatter(image, depth, lens)

    with pytest.raises(ValueError, match=r"`scatter\(max_coc=...\)` must be given under `jit`"):
        blurred(12.0)


PUBLIC = [
    *(dof.scatter, dof.layered, dof.depth_sorted, dof.gather, dof.blend, dof.separable),
    *(dof.anisotropic_diffusion, dof.implicit_diffusion, dof.peel),
]


@pytest.mark.parametrize("method", PUBLIC, ids=lambda method: method.__name__)
def test_what_is_no_lens_is_named(method):
    image, depth = scene()
    call, name = inspect.unwrap(method), method.__name__
    for wrong in (0.1, None, "lens", np.ones(3), ThinLens):
        with pytest.raises(
            ValueError, match=rf"`{name}\(lens\)` must be a lens, with `defocus"
        ):
            call(image, depth, wrong, max_coc=4)
    batch = jax.tree.map(lambda x: np.stack([x, x]), LENS)
    message = rf"`{name}\(lens\)` must be one ThinLens, whose `aperture` .* `jax.vmap`"
    with pytest.raises(ValueError, match=message):
        call(image, depth, batch, max_coc=4)
    narrow = Plain(LENS)
    narrow.defocus = lambda depth: np.ones(3)
    with pytest.raises(ValueError, match=rf"`{name}\(lens.defocus\)` must have shape"):
        call(image, depth, narrow, max_coc=4)


def image_of(result):
    """The image; `peel` has its depth beside it."""
    return result[0] if isinstance(result, tuple) else result


@first("method", PUBLIC, ids=lambda method: method.__name__)
def test_numbers_of_any_kind(method):
    image, depth = scene()
    call = lambda max_coc: image_of(inspect.unwrap(method)(image, depth, LENS, max_coc=max_coc))
    expected = call(4.0)
    for max_coc in (4, np.float32(4), np.int64(4), np.float64(4), jnp.asarray(4.0)):
        np.testing.assert_array_equal(call(max_coc), expected)
    for wrong in (True, np.True_, "4", [4], np.nan, np.inf, 0, -1, np.array([4.0])):
        name = rf"`{method.__name__}\(max_coc=...\)` must be positive, got"
        with pytest.raises(ValueError, match=name):
            inspect.unwrap(method)(image, depth, LENS, max_coc=wrong)


@first("method", PUBLIC, ids=lambda method: method.__name__)
def test_types_of_data(method):
    """Depths in whole numbers, halves and other machines' byte order are depths."""
    image, depth = scene()
    depth = np.rint(100 * depth)
    lens = ThinLens(20.0, 200.0, 60.0)
    call = lambda *data: image_of(inspect.unwrap(method)(*data, lens, max_coc=MAX_COC))
    expected = np.asarray(call(image, depth))
    for given in (depth.astype(np.uint16), depth.astype(">f8"), depth.tolist()):
        np.testing.assert_allclose(call(image, given), expected, rtol=1e-12)
    np.testing.assert_allclose(call(image.astype(">f8"), depth), expected, rtol=1e-12)
    half = call(image.astype(np.float16), (16 * depth).astype(np.float16) / np.float16(16))
    assert half.dtype == jnp.float16
    np.testing.assert_allclose(np.float64(half), expected, atol=5e-3)
