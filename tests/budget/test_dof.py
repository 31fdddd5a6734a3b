"""Plans for depth of field: their errors hold, and they name what they leave out."""

import importlib
import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import FocusPlanes, ThinLens, budget, dof
from jaxfx.budget.dof import Method, _parts


# The size of most images here, and of the parts of larger ones.
SIZE = (10, 10)


def scene(rng, widest, size=SIZE):
    """Cards at random depths before a wall, and the lens whose largest circle is `widest`."""
    y, x = np.mgrid[: size[0], : size[1]]
    image = rng.uniform(0, 1) * rng.uniform(0, 1, (*size, 3)) + rng.uniform(0, 0.5, 3)
    depth = np.full(size, rng.uniform(3, 9))
    for _ in range(rng.integers(0, 5)):
        cx, cy = rng.uniform(0, size[1]), rng.uniform(0, size[0])
        side = rng.uniform(size[0] / 10, size[0] / 2.5)
        card = (abs(x - cx) < side) & (abs(y - cy) < side)
        depth[card], image[card] = rng.uniform(1, 6), rng.uniform(0, 1, 3)
    lens = ThinLens(1.0, rng.uniform(1.5, 5), 1.0)
    largest = float(lens.circle_of_confusion(jnp.asarray(depth)).max())
    lens = eqx.tree_at(lambda lens: lens.aperture, lens, jnp.full((), widest / largest, float))
    return jnp.asarray(image), jnp.asarray(depth), lens


@pytest.fixture(scope="module")
def plans(promised):
    """Of images just large enough that candidates are tried on parts of them."""
    sizes = {0.9: 1.0, 9.9: 10.0}

    def full(image, depth, lens):
        widest = float(lens.circle_of_confusion(depth).max())
        return dof.scatter(image, depth, lens, max_coc=sizes[round(widest, 3)])

    random = lambda rng: scene(rng, rng.choice(list(sizes), p=[0.2, 0.8]), (32, 40))
    with pytest.MonkeyPatch.context() as patch:
        fewer = {"_SIDE": 8, "_PARTS": 3, "_MOST": 16, "_OTHERS": ("separable",)}
        for name, value in fewer.items():
            patch.setattr(importlib.import_module("jaxfx.budget.dof"), name, value)
        return promised(random, budget.dof, full, (-3, -1))


def test_no_plan_exceeds_its_error(plans):
    plans.are_kept()


def test_the_error_allowed_is_made_use_of(plans):
    plans.are_made_use_of(0.3)


def test_plans_differ_with_scenes_and_say_why(plans):
    titles = {str(plan).split(":")[0] for plan, _, _ in plans}
    assert len(titles) >= 3, titles
    for plan, _, error in plans:
        assert (error > 0) <= (len(plan.left_out) > 0)
        assert "error" in str(plan)
    assert any("by layered" in str(plan) for plan, _, _ in plans)


def test_nothing_is_done_where_no_circle_passes_its_pixel():
    image, depth, lens = scene(np.random.default_rng(1), 0.9)
    plan = budget.dof(image, depth, lens, max_error=0)
    assert "no circle of confusion passes its pixel" in str(plan)
    np.testing.assert_array_equal(plan(image, depth, lens), image)


def test_no_error_allowed_is_the_effect_itself():
    data = scene(np.random.default_rng(2), 9.9)
    plan = budget.dof(*data, max_error=0)
    assert plan.predicted_error == 0
    np.testing.assert_array_equal(plan(*data), dof.scatter(*data, max_coc=10.0))


@pytest.mark.full
def test_a_plan_may_approach_the_layered_effect():
    data = scene(np.random.default_rng(5), 9.9)
    full = dof.layered(*data, max_coc=10.0)
    plan = budget.dof(*data, max_error=0.03, effect="layered")
    error = float(np.sqrt(np.mean((plan(*data) - full) ** 2)))
    assert error == pytest.approx(float(plan.predicted_error), rel=1e-6, abs=1e-12)
    assert error <= 0.03
    assert "what hides what, by scatter" in str(plan)
    assert budget.dof(*data, max_error=0, effect="layered").recipe.name == "layered"


def test_parts_stand_for_a_picture_by_how_much_a_blur_changes_them():
    """All detail is in a few tiles: each of these, and one for all others."""
    size, rng = (448, 470), np.random.default_rng(6)
    image, depth = np.ones((*size, 1)), np.full(size, 4.0)
    busy = {(1, 2), (3, 0), (4, 4), (5, 5), (6, 6)}
    for row, column in busy:
        image[64 * row : 64 * row + 63, 64 * column : 64 * column + 63] += rng.uniform(
            0, 1, (63, 63, 1)
        )
    parts = _parts(image, jnp.asarray(depth), FocusPlanes(1.0, 2.0, 3.0, 10.0), 10.0)
    assert {part.data[0].shape for part in parts} == {(64, 64, 1)}
    assert sum(part.share for part in parts) == pytest.approx(1)
    assert sum(np.ptp(part.data[0]) > 0.5 for part in parts) >= 4
    assert _parts(image[:300, :300], depth[:300, :300], None, 10.0) == []


def test_a_flat_picture_of_large_circles_stays_flat_in_octaves():
    """A constant is kept by any quotient of two sums; an odd size has no block to lose."""
    image, depth = jnp.full((35, 39, 1), 0.7), jnp.full((35, 39), 4.0)
    lens = FocusPlanes(1.0, 2.0, 3.0, 13.9)
    np.testing.assert_allclose(
        Method("scatter in octaves", max_coc=14.0, split=8.0)(image, depth, lens),
        0.7,
        rtol=1e-9,
    )


def test_octaves_keep_the_energy_of_a_highlight_and_its_place():
    image, depth = jnp.zeros((35, 39, 1)).at[18, 20].set(100.0), jnp.full((35, 39), 4.0)
    lens = FocusPlanes(1.0, 2.0, 3.0, 13.9)
    blurred = Method("scatter in octaves", max_coc=14.0, split=8.0)(image, depth, lens)[..., 0]
    y, x = np.mgrid[:35, :39] + 0.5
    assert blurred.sum() == pytest.approx(100, rel=0.02)
    # The highlight's own centre, but for its block of four's: half a pixel.
    centre = [float((blurred * axis).sum() / blurred.sum()) for axis in (y, x)]
    np.testing.assert_allclose(centre, [19, 21], atol=0.05)


def test_a_plan_is_a_pytree_and_its_picture_has_a_gradient():
    data = scene(np.random.default_rng(3), 9.9)
    plan = budget.dof(*data, max_error=0.05)
    leaves, structure = jax.tree.flatten(plan)
    again = jax.tree.unflatten(structure, leaves)
    aperture = lambda a: ThinLens(a, data[2].focus_distance, data[2].focal_pixels)
    energy = lambda a: jnp.sum(again(data[0], data[1], aperture(a)) ** 2)
    start = 0.7 * data[2].aperture
    slope = (energy(start + 1e-5) - energy(start - 1e-5)) / 2e-5
    np.testing.assert_allclose(jax.grad(energy)(start), slope, rtol=1e-4)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_error": -1}, r"`dof\(max_error=...\)` must be a number, 0 or positive, got -1"),
        (
            {"max_error": 1, "effect": "x"},
            r"`dof\(effect=...\)` must be one of .*'layered'",
        ),
    ],
)
def test_a_wrong_argument_is_refused(options, message):
    data = scene(np.random.default_rng(3), 9.9)
    with pytest.raises(ValueError, match=message):
        inspect.unwrap(budget.dof)(*data, **options)


@pytest.mark.full
def test_a_plan_is_made_outside_of_transforms():
    image, depth, lens = scene(np.random.default_rng(3), 9.9)
    with pytest.raises(ValueError, match="must be given concrete data"):
        jax.jit(lambda image: budget.dof(image, depth, lens, max_error=1.0).predicted_error)(
            image
        )


@pytest.mark.parametrize("own", [False, True])
@pytest.mark.full
def test_missing_depths_and_lenses_of_ones_own(own):
    image, depth, thin = scene(np.random.default_rng(5), 9.0, (24, 30))
    depth = depth.at[3:7, 4:9].set(0).at[20, 20].set(np.nan)

    class Own:
        focus_distance = float(thin.focus_distance)
        defocus = staticmethod(thin.defocus)
        circle_of_confusion = staticmethod(thin.circle_of_confusion)

    lens = Own() if own else thin
    plan = budget.dof(image, depth, lens, max_error=0.01)
    error = plan(image, depth, lens) - dof.scatter(image, depth, lens)
    assert np.isfinite(error).all()
    assert np.sqrt(np.mean(np.square(error))) <= 0.01
    octave = Method("scatter in octaves", max_coc=10.0, split=8.0)(image, depth, lens)
    exact = dof.scatter(image, depth, thin, max_coc=10.0)
    assert np.sqrt(np.mean(np.square(octave - exact))) < 0.02
