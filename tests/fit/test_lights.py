"""The fit of lights: what lit an image is found in it; what can't be told apart is said."""

import functools
import inspect
import re

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from benchmarks.scenes.shadow import Boxes
from jaxfx import (
    AmbientLight,
    DirectionalLight,
    GBuffer,
    PointLight,
    SpotLight,
    fit,
    relight,
)
from tests.cases.lit import CAMERA, SIZE, cache


WHITE = np.ones(3)

TRUTH = (
    DirectionalLight([0.3, 0.5, 1.0], [1.0, 0.9, 0.7]),
    PointLight([-1.0, -1.2, 2.0], [1.0, 2.0, 3.0]),
    SpotLight([1.5, -0.5, 1.0], [-0.3, 0.2, 1.0], [4.0, 3.0, 2.0], 0.2, 0.5),
)
# 20 degrees off, a third to a half of the way to the surface, cones too blunt or too sharp.
WRONG = [
    (
        DirectionalLight([0.6, 0.3, 1.0], WHITE),
        PointLight([-0.6, -0.8, 1.6], WHITE),
        SpotLight([1.2, -0.2, 0.7], [-0.1, 0.0, 1.0], WHITE, 0.15, 0.65),
    ),
    (
        DirectionalLight([0.0, 0.6, 1.0], WHITE),
        PointLight([-1.3, -0.8, 2.2], WHITE),
        SpotLight([1.7, -0.8, 1.2], [-0.4, 0.3, 1.0], WHITE, 0.25, 0.45),
    ),
]


def wall(dtype=np.float64):
    """A matt plane that faces the camera."""
    plain = cache(dtype)
    normal = np.broadcast_to(np.array([0.0, 0.0, -1.0]), (SIZE, SIZE, 3))
    shader, depth = np.zeros((SIZE, SIZE), int), np.full((SIZE, SIZE), 4.0)
    images = plain.ambient, plain.diffuse, plain.specular
    return GBuffer(plain.color, shader, *images, normal, depth, plain.roughness)


def quietly(reference, gbuffer, lights, **options):
    return fit.lights(reference, gbuffer, CAMERA, lights, progress=False, **options)


def colors_of(reference, gbuffer, lights, **options):
    return quietly(reference, gbuffer, lights, parameters=("color",), **options)


def assert_close(found, truth, tolerance=0.01):
    """Of every field, its length being 1; directions are unit vectors."""
    for light, true in zip(found, truth, strict=True):
        for name in set(vars(true)) - {"light_size"}:  # None of them has one.
            value, wanted = (np.asarray(getattr(each, name)) for each in (light, true))
            if name == "direction":
                value, wanted = (each / np.linalg.norm(each) for each in (value, wanted))
            assert np.linalg.norm(value - wanted) < tolerance * np.linalg.norm(wanted), name


@functools.cache
def picture():
    return relight.render(cache(), CAMERA, TRUTH)


@pytest.mark.parametrize("start", WRONG, ids=["far", "near"])
@pytest.mark.full
def test_recovers_three_lights(start):
    assert_recovers(TRUTH, start, np.float64)


@pytest.mark.parametrize("start", WRONG, ids=["far", "near"])
@pytest.mark.full
def test_recovers_in_float32(start):
    assert_recovers(TRUTH[1:2], start[1:2], np.float32)


def assert_recovers(truth, start, dtype):
    reference = relight.render(cache(dtype), CAMERA, truth)
    fitted = quietly(reference, cache(dtype), start)
    assert fitted.success and fitted.image.dtype == dtype
    assert_close(fitted.lights, truth)
    assert fitted.indistinct == ()
    assert fitted.losses[-1] < 1e-6 * fitted.losses[0]
    np.testing.assert_allclose(fitted.image, reference, atol=1e-3)


@pytest.mark.full
def test_brightness_does_not_matter():
    """Nor do the start's colours, which are never used."""
    start = [type(light)(**vars(light) | {"color": 0 * WHITE}) for light in WRONG[0]]
    fitted = quietly(1e-5 * picture(), cache(), start)
    expected = [type(light)(**vars(light) | {"color": 1e-5 * light.color}) for light in TRUTH]
    assert_close(fitted.lights, expected)
    np.testing.assert_allclose(fitted.losses[-1], 0, atol=1e-14)


@pytest.mark.full
def test_what_is_frozen_stays():
    truth = TRUTH[1:]
    wrong = {"direction": WRONG[0][2].direction, "outer_angle": jnp.array(0.65)}
    start = (truth[0], SpotLight(**vars(truth[1]) | wrong))
    reference = relight.render(cache(), CAMERA, truth)
    fitted = quietly(reference, cache(), start, parameters=("direction", "angles"))
    assert_close(fitted.lights, truth)
    for name in ("color", "position"):
        for found, true in zip(fitted.lights, truth, strict=True):
            np.testing.assert_array_equal(getattr(found, name), getattr(true, name))
    assert [set(each) for each in fitted.standard_errors] == [set(), {"direction", "angles"}]


@pytest.mark.full
def test_failure_is_said():
    said = r"found no l\w+ in \d+ steps.*from [\de.-]+ to [\de.-]+"
    with pytest.raises(RuntimeError, match=said):
        quietly(picture(), cache(), WRONG[0], max_steps=2)
    fitted = quietly(picture(), cache(), WRONG[0], max_steps=2, throw=False)
    assert not fitted.success
    assert fitted.result == optx.RESULTS.nonlinear_max_steps_reached
    assert "maximum number of steps" in str(fitted.result)
    assert len(fitted.losses) == 3 and np.isfinite(fitted.losses).all()


SUNS = (
    AmbientLight([0.3, 0.2, 0.1]),
    DirectionalLight([0.3, 0.5, 1.0], [1.0, 0.9, 0.7]),
    DirectionalLight([-0.6, 0.1, 1.0], [0.2, 0.5, 1.5]),
)


def test_colors_alone_are_a_linear_problem():
    """By NumPy's least squares, of a reference that no lights explain; and the errors by those
    without each of 8 x 8 tiles in turn."""
    rng = np.random.default_rng(9)  # The surface's colours are drawn from 0.
    reference = rng.uniform(size=(SIZE, SIZE, 3))
    masks = [None, rng.uniform(size=(SIZE, SIZE)), rng.integers(0, 2, (SIZE, SIZE)) * 1.0]
    white = [type(light)(**vars(light) | {"color": WHITE}) for light in SUNS]
    columns = np.stack(
        [relight.shade(cache(), CAMERA, *each) for each in zip(white, masks, strict=True)]
    )
    given = rng.uniform(0.2, 1, (SIZE, SIZE))
    how = {"visibilities": masks, "weights": given, "loss": "squares", "throw": False}
    fitted = colors_of(reference, cache(), SUNS, **how)
    root, tile = np.sqrt(given).ravel(), np.arange(SIZE) // 4
    tile = (8 * tile[:, None] + tile).ravel()
    for c in range(3):
        matrix, right = columns[..., c].reshape(3, -1).T, reference[..., c].ravel()
        solve = lambda i, a=root[:, None] * matrix, b=root * right: np.linalg.lstsq(
            a[tile != i], b[tile != i], rcond=None
        )[0]
        np.testing.assert_allclose([each.color[c] for each in fitted.lights], solve(-1))
        without = np.array([solve(i) for i in range(64)])
        errors = [each["color"][c] for each in fitted.standard_errors]
        np.testing.assert_allclose(errors, np.sqrt(63 * np.var(without, axis=0)), rtol=1e-6)
    np.testing.assert_array_equal(fitted.weights, given)
    assert "contrast is explained" in fitted.doubt
    loss = np.mean(given[..., None] * (np.asarray(fitted.image) - reference) ** 2)
    assert len(fitted.losses) == 1
    np.testing.assert_allclose(fitted.losses[0], loss, rtol=1e-6)


def test_a_light_that_reaches_nothing():
    lights = (*SUNS[:2], PointLight([0.0, 0.0, 9.0], WHITE))
    reference = relight.render(cache(), CAMERA, SUNS)
    fitted = colors_of(reference, cache(), lights, throw=False)
    assert fitted.doubt == "The image does not determine the color of light 2."
    assert fitted.lights[2].color.tolist() == [0, 0, 0]
    assert fitted.standard_errors[2]["color"].tolist() == [np.inf] * 3
    assert np.isfinite(fitted.standard_errors[1]["color"]).all()
    assert fitted.indistinct == ()


SIDE = DirectionalLight([0.5, 0.0, 1.0], WHITE)
DEPENDENT = {
    "none": (cache, SUNS, ()),
    "twins": (cache, (SUNS[2], SUNS[1], SUNS[2], SUNS[0], SUNS[1]), ((0, 2), (1, 4))),
    "a wall": (wall, SUNS, ((0, 1, 2),)),
    "a wall and a lamp": (wall, (SUNS[1], TRUTH[1], SIDE), ((0, 2),)),
}


@pytest.mark.parametrize(("made", "lights", "groups"), DEPENDENT.values(), ids=DEPENDENT)
@pytest.mark.full
def test_lights_that_cannot_be_told_apart(made, lights, groups):
    reference = relight.render(made(), CAMERA, lights)
    fitted = colors_of(reference, made(), lights, throw=False)
    assert fitted.indistinct == groups and fitted.success == (not groups)
    for index, errors in enumerate(fitted.standard_errors):
        alone = all(index not in group for group in groups)
        assert np.isfinite(errors["color"]).all() == alone
    for group in groups:
        assert "can't tell apart" in fitted.doubt
        assert "lights " + " and ".join(map(str, group)) in fitted.doubt
    np.testing.assert_allclose(fitted.image, reference, rtol=1e-6, atol=1e-6)
    # Of lights that are the same, each takes the same share.
    for one, *others in groups if made is cache else ():
        for other in others:
            np.testing.assert_allclose(fitted.lights[one].color, fitted.lights[other].color)


@pytest.mark.full
def test_suns_over_a_matt_hill_are_dependent_but_for_three():
    """What is lit everywhere and has no highlight sees the sum of the suns alone."""
    hill = cache()
    normal = np.array([0.0, 0.0, -3.0]) + 0.5 * np.asarray(hill.normal)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    images = hill.ambient, hill.diffuse, hill.specular, normal, hill.depth, hill.roughness
    hill = GBuffer(hill.color, np.zeros((SIZE, SIZE), int), *images)
    directions = [(0.2, 0.1, 1), (-0.2, 0.1, 1), (0, -0.2, 1), (0.1, 0.3, 1)]
    suns = tuple(DirectionalLight(each, WHITE) for each in directions)
    reference = relight.render(hill, CAMERA, suns)
    assert colors_of(reference, hill, suns[:3], throw=False).indistinct == ()
    assert colors_of(reference, hill, suns, throw=False).indistinct == ((0, 1, 2, 3),)


@pytest.mark.full
def test_standard_errors_are_the_spread_over_draws_of_noise():
    reference = relight.render(cache(), CAMERA, SUNS)
    rng = np.random.default_rng(2)
    misses = []
    for _ in range(64):
        fitted = colors_of(reference + rng.normal(0, 0.02, reference.shape), cache(), SUNS)
        misses.append(
            [
                (light.color - true.color) / errors["color"]
                for light, true, errors in zip(
                    fitted.lights, SUNS, fitted.standard_errors, strict=True
                )
            ]
        )
    spread = np.std(misses, axis=0)
    assert ((spread > 0.7) & (spread < 1.3)).all(), spread


@pytest.mark.parametrize("missing", [0.0, -1.0, np.nan])
@pytest.mark.full
def test_a_pixel_whose_depth_is_missing_has_no_say(missing):
    gbuffer, lights = cache(), TRUTH[:2]
    reference = relight.render(gbuffer, CAMERA, lights)
    lost = np.zeros((SIZE, SIZE), bool)
    lost[3:9, 12:20] = lost[20, 20] = True
    holed = eqx.tree_at(lambda g: g.depth, gbuffer, jnp.where(lost, missing, gbuffer.depth))
    wrong = jnp.where(lost[..., None], 7.0, reference)
    start = [WRONG[0][0], WRONG[0][1]]
    found = quietly(wrong, holed, start)
    assert found.success
    assert_close(found.lights, lights, 1e-3)


# Behind the surface, and turned away from it: neither lights anything.
AWAY = (PointLight([0.0, 0.0, 50.0], WHITE), SpotLight([0, 0, -1], [0, 0, -1], WHITE, 0.2, 0.3))


@pytest.mark.parametrize("light", AWAY, ids=lambda light: type(light).__name__)
@pytest.mark.full
def test_a_start_that_nothing_moves_is_said(light, caplog):
    """The log names it beside others; alone it is an error."""
    fitted = quietly(picture(), cache(), (*SUNS, light), throw=False)
    (message,) = {record.getMessage() for record in caplog.records if record.name == "jaxfx"}
    assert "can't move" in message and f"position of light {len(SUNS)}" in message
    np.testing.assert_array_equal(fitted.lights[-1].position, light.position)
    assert np.isinf(fitted.standard_errors[-1]["position"]).all()
    with pytest.raises(ValueError, match=r"`lights\(lights\)` must start where.* position of"):
        quietly(picture(), cache(), (light,), parameters=("position",))


def test_a_start_that_moves_says_nothing(caplog):
    fitted = quietly(picture(), cache(), SUNS, parameters=("color",), throw=False)
    assert not caplog.records
    assert str(fitted.result) == repr(fitted.result) == "The search converged."


FAULTS = {
    "lights(reference)": {"reference": np.zeros((SIZE, SIZE))},
    "lights(reference) must hold floats": {"reference": np.zeros((SIZE, SIZE, 3), np.uint8)},
    "lights(reference) must have the cache's shape": {"reference": np.zeros((SIZE, 9, 3))},
    "lights(reference) must be finite": {"reference": np.full((SIZE, SIZE, 3), np.inf)},
    "lights(gbuffer)": {"gbuffer": np.zeros((SIZE, SIZE))},
    "lights(lights)": {"lights": ()},
    "lights(lights[1])": {"lights": (*SUNS[:1], "sun")},
    "lights(visibilities=...) must have an entry": {"visibilities": [None]},
    "lights(visibilities=...) must have shape": {"visibilities": [None, None, np.ones((3, 3))]},
    "lights(visibilities=...) must have shape (32, 32)": {
        "visibilities": [None, None, lambda light: np.ones((3, 3))]
    },
    "lights(parameters=...)": {"parameters": ("colour",)},
    "lights(parameters=...) must name some": {"parameters": ()},
    "lights(parameters=...) must": {"parameters": ("angles",)},
    "lights(weights=...) must have": {"weights": np.ones((SIZE, 9))},
    "lights(weights=...) must be finite": {"weights": np.full((SIZE, SIZE), -1.0)},
    "lights(weights=...)": {"weights": np.zeros((SIZE, SIZE))},
    "lights(loss=...)": {"loss": "huber"},
    "lights(rounds=...)": {"rounds": 0},
    "lights(max_steps=...)": {"max_steps": 0.5},
}


@pytest.mark.parametrize(("message", "fault"), FAULTS.items(), ids=FAULTS)
def test_bad_arguments_are_named(message, fault):
    given = {"reference": picture(), "gbuffer": cache(), "lights": SUNS} | fault
    call, _, rest = message.partition(" ")
    with pytest.raises(ValueError, match=re.escape(f"`{call}` {rest}")):
        inspect.unwrap(fit.lights)(camera=CAMERA, **given | {"progress": False})


@functools.cache
def boxes():
    """Boxes on a floor, which tell where the sun is by their shadow alone."""
    return Boxes()


@pytest.mark.parametrize("about", [0.4, 0.4 + np.pi])
@pytest.mark.full
def test_a_sun_by_its_shadow(about):
    sky, sun = (
        AmbientLight(WHITE),
        DirectionalLight(boxes().turned(np.radians(15), about), WHITE),
    )
    assert boxes().miss(sun) == pytest.approx(15)
    fitted = fit.lights(
        boxes().photograph(),
        boxes().gbuffer,
        boxes().eye,
        (sky, sun),
        visibilities=boxes().shadows,
        rounds=len(boxes().scales),
        loss="squares",
        progress=False,
    )
    assert fitted.success and fitted.indistinct == ()
    assert boxes().miss(fitted.lights[1]) < 0.5


@pytest.mark.full
def test_without_shadows_a_sun_is_a_sky():
    """Nor can its height be told from its brightness."""
    start = AmbientLight(WHITE), DirectionalLight(boxes().sun, WHITE)
    data = boxes().photograph(), boxes().gbuffer, boxes().eye
    how = {"parameters": ("color",), "throw": False, "progress": False}
    plain = fit.lights(*data, start, **how)
    assert plain.indistinct == ((0, 1),)
