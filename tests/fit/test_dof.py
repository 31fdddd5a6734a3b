"""`fit.dof`: the lens that drew an image is recovered from it; failures are stated."""

import functools
import inspect
import itertools
import re

import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
import pytest

from jaxfx import FocusPlanes, ThinLens, dof, fit
from tests.helpers.forms import first


SIZE = 48
TRUTH = {"aperture": 0.12, "focus_distance": 3.0, "gamma": 1.5, "epsilon": 2.0}
# How far off a start may be, as a factor, to one side and to the other.
WRONG = {
    "aperture": (0.6, 1.4),
    "focus_distance": (0.85, 1.15),
    "gamma": (1 / 2.5, 2.5),
    "epsilon": (1 / 2.5, 2.5),
}


def still_life(size=SIZE):
    """A checkered floor that rises into the distance, and four discs before and behind it."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:size, :size] / size
    c = np.arange(3)
    checks = np.sin(40 * x[..., None] + 3 * c) * np.cos(31 * y[..., None] - c) > 0
    image = 0.2 + 0.6 * checks + 0.2 * rng.random((size, size, 3))
    depth = 3 + 4 * y
    discs = [
        (0.3, 0.4, 0.15, 1.5),
        (0.7, 0.6, 0.2, 2.2),
        (0.5, 0.8, 0.1, 3),
        (0.8, 0.2, 0.15, 10),
    ]
    for centre_x, centre_y, radius, z in discs:
        inside = (x - centre_x) ** 2 + (y - centre_y) ** 2 < radius**2
        image[inside], depth[inside] = rng.random(3), z
    return image, depth


def options(values, dtype=np.float64):
    """The arguments that `scatter` and `fit.dof` share, from values by name."""
    values = {name: np.asarray(value, dtype) for name, value in values.items()}
    focal_pixels = np.asarray(120.0, dtype)
    lens = ThinLens(values["aperture"], values["focus_distance"], focal_pixels)
    return {"lens": lens, "gamma": values["gamma"], "epsilon": values["epsilon"]}


def wrong(sides):
    return {
        name: TRUTH[name] * WRONG[name][side] for name, side in zip(TRUTH, sides, strict=True)
    }


def found(fitted):
    lens = fitted.lens
    values = (lens.aperture, lens.focus_distance, fitted.gamma, fitted.epsilon)
    return dict(zip(fit.PARAMETERS, map(float, values), strict=True))


@functools.cache
def picture(dtype=np.float64):
    image, depth = (array.astype(dtype) for array in still_life())
    return dof.scatter(image, depth, **options(TRUTH, dtype)), image, depth


def quietly(reference, image, depth, values=TRUTH, max_coc=8, **kwargs):
    arguments = options(values, image.dtype) | kwargs
    return fit.dof(reference, image, depth, max_coc=max_coc, progress=False, **arguments)


@first("dtype", [np.float32, np.float64])
@first("sides", list(itertools.product((0, 1), repeat=4)), ids=str)
def test_recovers_what_made_the_picture(sides, dtype):
    fitted = quietly(*picture(dtype), wrong(sides))
    assert fitted.success
    assert fitted.image.dtype == fitted.gamma.dtype == dtype
    assert float(fitted.clamped) == 0
    assert found(fitted) == pytest.approx(TRUTH, rel=0.01)
    losses = np.asarray(fitted.losses)
    assert losses[-1] < 1e-3 * losses[0]
    # Seven searches, none of which goes on for long once it has arrived.
    assert len(losses) < 80


@pytest.mark.full
def test_the_threshold_of_layered_scatter_is_found():
    image, depth = still_life(16)
    lens = lambda factor: ThinLens(factor * 0.12, 3.0 / factor, 40.0)
    draw = functools.partial(dof.layered, image, depth, max_coc=4.0, behind=None)
    fitted = fit.dof(
        *(draw(lens(1.0), threshold=1.2), image, depth, lens(0.95)),
        effect="layered",
        threshold=2.0,
        max_coc=4.0,
        progress=False,
    )
    values = fitted.lens.aperture, fitted.lens.focus_distance, fitted.threshold
    np.testing.assert_allclose(values, (0.12, 3.0, 1.2), rtol=0.01)
    assert set(fitted.standard_errors) == set(fit.LAYERED_PARAMETERS)


@pytest.mark.full
def test_a_second_layer_is_guessed_for_each_lens_that_is_tried():
    """Of an image that `layered` drew with its guess, only a fit with the guess is exact."""
    image, depth = still_life(24)
    start, truth = ThinLens(0.14, 2.8, 100.0), ThinLens(0.12, 3.0, 100.0)
    photograph = dof.layered(image, depth, truth, max_coc=8.0)
    options = {"effect": "layered", "parameters": ("aperture", "focus_distance")}
    options |= {"loss": "squares", "max_coc": 8.0, "throw": False}
    found = fit.dof(photograph, image, depth, start, behind="peel", **options)
    values = found.lens.aperture, found.lens.focus_distance
    np.testing.assert_allclose(values, (0.12, 3.0), rtol=1e-6)
    single = fit.dof(photograph, image, depth, start, **options)
    assert found.losses[-1] < 1e-6 * single.losses[-1]


@pytest.mark.full
def test_a_lens_that_no_derivative_moves_may_be_held():
    """Circles below a pixel show no lens, but the other parameters can be fitted."""
    image, depth = still_life(16)
    lens = ThinLens(1e-3, 3.0, 120.0)
    how = {"parameters": ("gamma",), "max_coc": 2.0, "throw": False}
    held = fit.dof(0.9 * image, image, depth, lens, **how)
    assert held.lens.aperture == lens.aperture
    assert held.standard_errors["gamma"] > 1e6


@pytest.mark.full
def test_losses_open_with_the_start_and_the_image_is_the_fitted_one():
    reference, image, depth = picture()
    start = dof.scatter(image, depth, **options(wrong((1, 1, 1, 1))))
    fitted = quietly(reference, image, depth, wrong((1, 1, 1, 1)))
    np.testing.assert_allclose(fitted.losses[0], jnp.mean((start - reference) ** 2))
    again = dof.scatter(image, depth, **options(found(fitted)))
    np.testing.assert_allclose(fitted.image, again, atol=1e-12)


@pytest.mark.full
def test_a_search_whose_circles_outgrow_the_bound_goes_on_with_a_larger_one():
    fitted = quietly(*picture(), wrong((0, 0, 1, 1)), max_coc=None)
    assert fitted.success and fitted.clamped == 0
    assert found(fitted) == pytest.approx(TRUTH, rel=0.01)


@pytest.mark.full
def test_the_share_of_clamped_pixels_is_reported():
    reference, image, depth = picture()
    fitted = quietly(reference, image, depth, parameters=("gamma",), max_coc=3.5)
    share = np.mean(fitted.lens.circle_of_confusion(jnp.asarray(depth)) > 3.5)
    assert 0 < share < 1
    assert fitted.clamped == pytest.approx(share)


@pytest.mark.parametrize(
    "free", [("aperture", "focus_distance"), ("epsilon", "gamma")], ids="-".join
)
@pytest.mark.full
def test_what_is_frozen_stays(free):
    start = TRUTH | {name: wrong((1, 1, 1, 1))[name] for name in free}
    fitted = quietly(*picture(), start, parameters=free)
    assert found(fitted) == pytest.approx(TRUTH, rel=0.01)
    assert all(found(fitted)[name] == TRUTH[name] for name in TRUTH if name not in free)
    assert set(fitted.standard_errors) == set(free)


TOLERANCE = {"rtol": 1e-6, "atol": 1e-8}


@first(
    "solver",
    [
        optx.GaussNewton(**TOLERANCE),
        optx.Dogleg(**TOLERANCE),
        optx.BFGS(**TOLERANCE),
    ],
    ids=lambda solver: type(solver).__name__,
)
@pytest.mark.full
def test_any_solver_or_minimiser(solver):
    fitted = quietly(
        *picture(),
        TRUTH | {"aperture": 0.13, "focus_distance": 3.1},
        parameters=("aperture", "focus_distance"),
        solver=solver,
    )
    assert fitted.success
    assert found(fitted) == pytest.approx(TRUTH, rel=0.01)


@pytest.mark.full
def test_failure_is_stated():
    start = wrong((0, 1, 0, 1))
    said = r"found no l\w+ in \d+ steps.*from [\de.-]+ to [\de.-]+"
    with pytest.raises(RuntimeError, match=said):
        quietly(*picture(), start, max_steps=3)
    fitted = quietly(*picture(), start, max_steps=3, throw=False)
    assert not fitted.success
    assert "maximum number of steps" in str(fitted.result) and "maximum" in repr(fitted)
    assert fitted.result == optx.RESULTS.nonlinear_max_steps_reached
    assert np.isfinite(fitted.losses).all()


def behind_the_focus():
    """A textured plane far behind the focus, where gamma and epsilon change nothing."""
    image, _ = still_life()
    depth = np.full(image.shape[:2], 9.0)
    values = TRUTH | {"epsilon": 1.0}
    reference = dof.scatter(image, depth, **options(values))
    noise = np.random.default_rng(1).normal(0, 0.01, image.shape)
    return reference + noise, image, depth, values


@pytest.mark.full
def test_a_solver_that_breaks_down_leaves_what_it_had():
    # Without damping, a parameter without a derivative is a division by zero.
    reference, image, depth, values = behind_the_focus()
    solver = optx.GaussNewton(linear_solver=lx.QR(), **TOLERANCE)
    fitted = quietly(reference, image, depth, values, solver=solver, throw=False)
    assert not fitted.success
    assert found(fitted) == pytest.approx(values)


@pytest.mark.full
def test_what_the_image_does_not_determine_has_a_large_error():
    fitted = quietly(*behind_the_focus(), throw=False)
    assert not fitted.success and "do not determine aperture" in fitted.doubt
    assert fitted.untold == fit.PARAMETERS
    assert fitted.standard_errors["gamma"] == fitted.standard_errors["epsilon"] == np.inf
    # One plane has one circle of confusion: the aperture or the focus may have made it.
    assert fitted.standard_errors["aperture"] > TRUTH["aperture"]
    alone = quietly(*behind_the_focus(), parameters=("aperture",), loss="squares")
    assert alone.standard_errors["aperture"] < 0.01 * TRUTH["aperture"]


@pytest.mark.full
def test_standard_errors_are_the_spread_over_draws_of_noise():
    reference, image, depth = picture()
    rng = np.random.default_rng(2)
    misses = []
    for _ in range(24):
        noise = rng.normal(0, 0.01, reference.shape)
        # The robust loss adds what an effect draws wrong, which is nothing here.
        fitted = quietly(reference + noise, image, depth, loss="squares")
        values = found(fitted)
        misses.append(
            [(values[name] - TRUTH[name]) / fitted.standard_errors[name] for name in TRUTH]
        )
    # By the median: one draw in eight makes epsilon's other minimum, at 1.4, the lower one.
    spread = np.median(np.abs(misses), axis=0) / 0.6745
    assert ((spread > 0.5) & (spread < 2)).all(), spread


@pytest.mark.full
def test_pixels_without_weight_do_not_count():
    """A quarter of the reference is of another lens; with weights it does not matter."""
    reference, image, depth = picture()
    spoiled, weights = np.array(reference), np.ones((SIZE, SIZE))
    spoiled[: SIZE // 2, : SIZE // 2], weights[: SIZE // 2, : SIZE // 2] = 0.9, 0
    start = wrong((0, 1, 1, 0))
    left_out = quietly(spoiled, image, depth, start, weights=weights)
    assert found(left_out) == pytest.approx(TRUTH, rel=0.01)
    told = quietly(spoiled, image, depth, start, throw=False, loss="squares")
    assert found(told) != pytest.approx(TRUTH, rel=0.05)
    # Twice the weights are twice the loss and the same fit.
    heavy = quietly(reference, image, depth, start, weights=np.full((SIZE, SIZE), 2.0))
    plain = quietly(reference, image, depth, start)
    assert float(heavy.losses[0]) == pytest.approx(2 * float(plain.losses[0]))
    assert found(heavy) == pytest.approx(found(plain), rel=1e-4)


FAULTS = {
    "dof(image)": {"image": np.zeros((4, 4), np.float64)},
    "dof(image) must hold floats": {"image": np.zeros((SIZE, SIZE, 3), np.uint8)},
    "dof(reference)": {"reference": np.zeros((SIZE, SIZE - 1, 3))},
    "dof(reference) must be finite": {"reference": np.full((SIZE, SIZE, 3), np.nan)},
    "dof(depth)": {"depth": np.ones((SIZE, SIZE + 1))},
    "dof(depth) must be known somewhere": {"depth": np.zeros((SIZE, SIZE))},
    "dof(lens)": {"lens": FocusPlanes(1.0, 2.0, 3.0, 4.0)},
    "dof(lens.aperture)": {"lens": ThinLens(0.0, 3.0, 120.0)},
    "dof(lens) must start with a circle": {"lens": ThinLens(1e-3, 3.0, 120.0)},
    "dof(lens) must start": {"lens": ThinLens(5.0, 0.1, 120.0), "max_coc": 2.0},
    "dof(gamma=...)": {"gamma": -1.0},
    "dof(epsilon=...)": {"epsilon": np.zeros(2)},
    "dof(weights=...)": {"weights": np.ones((SIZE, SIZE + 1))},
    "dof(weights=...) must be finite": {"weights": np.zeros((SIZE, SIZE))},
    "dof(parameters=...)": {"parameters": ("aperture", "focal_pixels")},
    "dof(parameters=...) must name some": {"parameters": ()},
    "dof(parameters=...) must name some of ('aperture', 'focus_distance', 'threshold',": {
        "effect": "layered",
        "parameters": ("gamma",),
    },
    "dof(effect=...)": {"effect": "gather"},
    "dof(threshold=...)": {"threshold": -1.0},
    "dof(max_steps=...)": {"max_steps": 0},
    "dof(loss=...)": {"loss": "huber"},
    "dof(tone=...)": {"tone": "gamma"},
    "dof(exposure=...)": {"exposure": 1.0},
    "dof(ratios=...) must name some": {"ratios": ("gamma",)},
    "dof(lens) must be one for each of 2 photographs": {
        "reference": [np.zeros((SIZE, SIZE, 3)), np.zeros((SIZE, SIZE, 3))]
    },
    "dof(reference[1]) must have the image's shape": {
        "reference": [np.zeros((SIZE, SIZE, 3)), np.zeros((SIZE, SIZE - 1, 3))]
    },
    "dof(behind=...)[0]": {"behind": (np.zeros((4, 4)), np.ones((4, 4)))},
    "dof(behind=...)[0] must have shape": {
        "effect": "layered",
        "behind": (np.zeros((SIZE, SIZE, 1)), np.ones((SIZE, SIZE))),
    },
    "dof(behind=...) must be one of ('peel',)": {"effect": "layered", "behind": "guess"},
    "dof(max_coc=...) must be positive": {"max_coc": -1},
    "dof(max_coc=...) must be positive and finite": {"max_coc": np.inf},
}


@pytest.mark.parametrize(("message", "fault"), FAULTS.items(), ids=FAULTS)
def test_bad_arguments_are_named(message, fault):
    reference, image, depth = picture()
    given = {"reference": reference, "image": image, "depth": depth} | options(TRUTH)
    call, _, rest = message.partition(" ")
    with pytest.raises(ValueError, match=re.escape(f"`{call}` {rest}")):
        inspect.unwrap(fit.dof)(**given | {"progress": False} | fault)


@pytest.mark.full
def test_missing_depths_do_not_spoil_a_fit():
    """A tenth of the depths is missing, by each of the signs for it."""
    reference, image, depth = picture()
    holed = np.array(depth)
    holes = np.random.default_rng(1).random(holed.shape) < 0.1
    holed[holes] = np.resize([0.0, np.nan, -1.0], holes.sum())
    exact = dof.scatter(image, holed, **options(TRUTH), max_coc=16)
    result = fit.dof(
        exact, image, holed, **options(wrong((0, 1, 0, 1))), max_coc=16, progress=False
    )
    assert np.isfinite(result.losses).all()
    for name, value in found(result).items():
        assert value == pytest.approx(TRUTH[name], rel=0.02), name
    with pytest.raises(ValueError, match=r"`dof\(depth\)` must be known somewhere, got"):
        inspect.unwrap(fit.dof)(reference, image, 0 * holed, options(TRUTH)["lens"])


@pytest.mark.full
def test_wrong_pixels_do_not_decide():
    """Three in a hundred pixels of the reference are lamps of twenty times white."""
    reference, image, depth = picture()
    spoiled = np.array(reference)
    spoiled[np.random.default_rng(3).random(depth.shape) < 0.03] = 20.0
    fitted = quietly(spoiled, image, depth, wrong((0, 1, 1, 0)), throw=False)
    assert found(fitted) == pytest.approx(TRUTH, rel=0.02)
    assert fitted.explained == pytest.approx(np.mean(spoiled < 20), abs=1e-3)
    # The ends of the searches are reported, the best first.
    ends = [float(end["aperture"][0]) for end in fitted.ends]
    assert ends[0] == pytest.approx(TRUTH["aperture"], rel=0.02) and len(ends) >= 3


def test_where_one_lens_looks_best_one_search_is_made():
    reference, image, depth = picture()
    begins = options(TRUTH | {"aperture": 1.4 * TRUTH["aperture"]})
    seek = {"parameters": ("aperture",), "max_coc": 16, "loss": "squares"}
    fitted = fit.dof(reference, image, depth, **begins, **seek)
    assert len(fitted.ends) == 1
    assert found(fitted)["aperture"] == pytest.approx(TRUTH["aperture"], rel=1e-3)


@pytest.mark.full
def test_gain_and_offset_are_found_beside_the_lens():
    reference, image, depth = picture()
    gain, offset = np.array([1.25, 0.8, 1.1]), np.array([0.02, -0.01, 0.03])
    start = TRUTH | {"aperture": 0.09, "focus_distance": 3.4}
    options = {"parameters": ("aperture", "focus_distance"), "tone": "log"}
    shown = gain * np.asarray(reference) + offset
    fitted = quietly(shown, image, depth, start, exposure="free", **options)
    assert found(fitted) == pytest.approx(TRUTH, rel=0.01)
    np.testing.assert_allclose(fitted.gain, gain[None], rtol=0.01)
    np.testing.assert_allclose(fitted.offset, offset[None], atol=0.01)
    # The image is the method's own.
    np.testing.assert_allclose(fitted.image, reference, atol=0.02)


def focus_pull(foci):
    """Images through one aperture at several focus distances, and their lenses."""
    _, image, depth = picture()
    lenses = [ThinLens(0.12, focus, 120.0) for focus in foci]
    amplified = {"gamma": TRUTH["gamma"], "epsilon": TRUTH["epsilon"], "max_coc": 8.0}
    return [dof.scatter(image, depth, lens, **amplified) for lens in lenses], lenses


@pytest.mark.full
def test_known_lenses_determine_scale_and_shift_of_disparity():
    pictures, lenses = focus_pull((3.0, 5.0))
    _, image, depth = picture()
    given = 1 / ((1 / depth + 0.02) / 1.2)  # 1 / depth is 1.2 / given - 0.02
    amplified = {"gamma": TRUTH["gamma"], "epsilon": TRUTH["epsilon"]}
    fitted = fit.dof(
        *(pictures, image, given, lenses),
        **(amplified | {"parameters": fit.DISPARITY_PARAMETERS, "max_coc": 8.0}),
    )
    assert fitted.scale == pytest.approx(1.2, rel=0.01)
    assert fitted.shift == pytest.approx(-0.02, abs=2e-3)
    assert fitted.success and fitted.untold == ()
    assert fitted.images.shape == (2, *image.shape)
    np.testing.assert_allclose(fitted.images, jnp.stack(pictures), atol=0.02)


@pytest.mark.full
def test_one_image_does_not_determine_a_lens_and_disparity_at_once():
    """The defocus is aperture x (1 / focus - scale / depth - shift): four numbers for two."""
    _, image, depth = picture()
    values = TRUTH | {"gamma": 0.0}
    reference = dof.scatter(image, depth, **options(values), max_coc=8.0)
    reference = reference + np.random.default_rng(0).normal(0, 0.01, image.shape)
    free = ("aperture", "focus_distance", *fit.DISPARITY_PARAMETERS)
    fitted = quietly(reference, image, depth, values, parameters=free, throw=False)
    assert not fitted.success and set(fitted.untold) >= {"aperture", "scale"}


@pytest.mark.full
def test_several_images_determine_one_aperture():
    pictures, lenses = focus_pull((2.5, 4.0))
    _, image, depth = picture()
    starts = [ThinLens(0.09, 1.15 * lens.focus_distance, 120.0) for lens in lenses]
    amplified = {"gamma": TRUTH["gamma"], "epsilon": TRUTH["epsilon"], "max_coc": 8.0}
    free = {"parameters": ("aperture", "focus_distance"), "ratios": ("aperture",)}
    noise = np.random.default_rng(0).normal(0, 0.01, (2, *image.shape))
    noisy = [each + extra for each, extra in zip(pictures, noise, strict=True)]
    fitted = fit.dof(noisy, image, depth, starts, **amplified, **free)
    foci = [float(lens.focus_distance) for lens in fitted.lenses]
    np.testing.assert_allclose(foci, (2.5, 4.0), rtol=0.02)
    np.testing.assert_allclose([lens.aperture for lens in fitted.lenses], 0.12, rtol=0.02)
    assert fitted.standard_errors["focus_distance"].shape == (2,)
    # One aperture for both: the second image's error is the first's.
    errors = fitted.standard_errors["aperture"]
    assert float(errors[0]) == pytest.approx(float(errors[1]))


@pytest.mark.full
def test_errors_of_noise_fall_with_the_number_of_photographs_and_others_do_not():
    """Four photographs through one lens: what the effect draws wrong is wrong in each."""
    pictures, lenses = focus_pull((3.0,) * 4)
    _, image, depth = picture()
    noise = np.random.default_rng(0).normal(0, 0.01, (4, *image.shape))
    how = {"gamma": TRUTH["gamma"], "epsilon": TRUTH["epsilon"], "max_coc": 8.0}
    how |= {"parameters": ("aperture",), "ratios": ("aperture",)}
    errors = {"squares": [], "robust": []}
    for count, loss in itertools.product((1, 4), errors):
        noisy = [
            np.asarray(p) + n for p, n in zip(pictures[:count], noise[:count], strict=True)
        ]
        fitted = fit.dof(noisy, image, depth, lenses[:count], loss=loss, **how)
        errors[loss].append(float(np.ravel(fitted.standard_errors["aperture"])[0]))
    assert errors["squares"][1] == pytest.approx(errors["squares"][0] / 2, rel=0.3)
    assert errors["robust"][1] == pytest.approx(errors["robust"][0], rel=0.1)
