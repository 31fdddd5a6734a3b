"""Shading against a plain loop over pixels, hand-made pixels and finite differences."""

import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import (
    AmbientLight,
    DirectionalLight,
    GBuffer,
    OrthographicCamera,
    PinholeCamera,
    PointLight,
    SpotLight,
    relight,
)
from tests.cases.relight_views import FRONT, REFLECTANCES, one_pixel, sun
from tests.helpers.forms import first


SHADERS = {"lambert": 0, "phong": 1, "blinn": 2}
LIGHTS = {
    "ambient": AmbientLight([0.3, 0.2, 0.1]),
    "directional": DirectionalLight([0.3, 0.5, 2.0], [1.0, 2.0, 3.0]),
    "point": PointLight([-0.6, -0.9, 0.2], [3.0, 2.0, 1.0]),
    "spot": SpotLight([0.4, -0.5, 0.1], [-0.4, 0.3, 2.0], [3.0, 4.0, 5.0], 0.05, 0.7),
}


def make_camera(kind, height, width):
    pinhole = PinholeCamera.look_at(
        [0.3, -0.4, 0.2], [0.1, 0.2, 3], up=[0.2, -1, 0], fov_y=0.7, height=height, width=width
    )
    if kind == "pinhole":
        return pinhole
    return OrthographicCamera(height / 2, [width / 2, height / 2], pinhole.world_from_camera)


def make_gbuffer(seed, height=7, width=9, background=True):
    """Surfaces that more or less face the camera, of all models, with some background."""
    rng = np.random.default_rng(seed)
    shape = (height, width)
    normal = rng.normal((0, 0, -1), 0.4, (*shape, 3))
    shader = rng.permutation(height * width).reshape(shape) % (4 if background else 3)
    shader = np.where(shader == 3, -1, shader)
    return GBuffer(
        **{name: rng.uniform(0.1, 1, (*shape, 3)) for name in REFLECTANCES},
        shader=shader,
        normal=normal / np.linalg.norm(normal, axis=-1, keepdims=True),
        depth=np.where(shader == -1, np.inf, rng.uniform(1.5, 4, shape)),
        roughness=rng.uniform(0.3, 0.9, shape),
    )


def cast(tree, dtype):
    floats, others = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(jax.tree.map(lambda leaf: np.asarray(leaf, dtype), floats), others)


def loop(gbuffer, camera, light):
    """The page's equations, pixel by pixel, in float64."""
    unit = lambda v: v / np.linalg.norm(v)
    number = lambda v: np.asarray(v, np.float64)
    shader, depth = np.asarray(gbuffer.shader), number(gbuffer.depth)
    image = np.zeros((*depth.shape, 3))
    pose = number(camera.world_from_camera)
    for j, i in np.ndindex(depth.shape):
        if shader[j, i] == -1:
            continue
        ambient, diffuse, specular, normal, roughness = (
            number(getattr(gbuffer, name))[j, i]
            for name in ("ambient", "diffuse", "specular", "normal", "roughness")
        )
        color = number(light.color)
        if isinstance(light, AmbientLight):
            image[j, i] = color * ambient
            continue

        if isinstance(camera, PinholeCamera):
            ray = np.linalg.inv(number(camera.intrinsics)) @ [i + 0.5, j + 0.5, 1]
            position = pose[:3, :3] @ (ray * depth[j, i]) + pose[:3, 3]
            to_camera = unit(pose[:3, 3] - position)
        else:
            plane = [i + 0.5, j + 0.5] - number(camera.center)
            local = [*(plane / number(camera.pixels_per_unit)), depth[j, i]]
            position = pose[:3, :3] @ local + pose[:3, 3]
            to_camera = unit(-pose[:3, 2])

        if isinstance(light, DirectionalLight):
            to_light = unit(-number(light.direction))
        else:
            offset = number(light.position) - position
            to_light = unit(offset)
            color = color / (offset @ offset)
        if isinstance(light, SpotLight):
            inner, outer = np.cos(number(light.inner_angle)), np.cos(number(light.outer_angle))
            s = np.clip(
                (-to_light @ unit(number(light.direction)) - outer) / (inner - outer), 0, 1
            )
            color = color * (3 * s**2 - 2 * s**3)

        normal = unit(normal)
        cosine = normal @ to_light
        if cosine <= 0:
            continue
        mirrored = 2 * cosine * normal - to_light
        halfway = unit(to_light + to_camera)
        bases = {0: 0.0, 1: max(mirrored @ to_camera, 0), 2: max(normal @ halfway, 0)}
        highlight = bases[int(shader[j, i])] ** (2 / roughness**2 - 2)
        image[j, i] = color * (diffuse * cosine + specular * highlight)
    return image


each_light = pytest.mark.parametrize("light", LIGHTS.values(), ids=LIGHTS.keys())
each_camera = pytest.mark.parametrize("camera", ["pinhole", "orthographic"])


@each_light
@each_camera
@pytest.mark.parametrize("shader", SHADERS.values(), ids=SHADERS.keys())
def test_equals_the_loop(camera, light, shader):
    gbuffer = make_gbuffer(shader)
    shaders = np.where(np.asarray(gbuffer.shader) < 0, -1, shader)
    gbuffer = eqx.tree_at(lambda g: g.shader, gbuffer, shaders)
    camera = make_camera(camera, 7, 9)
    expected = loop(gbuffer, camera, light)
    assert (expected > 0).any(axis=-1).sum() > 10
    result = relight.shade(gbuffer, camera, light)
    np.testing.assert_allclose(result, expected, rtol=1e-10, atol=1e-13)


@first("light", [*LIGHTS.values()][::-1], ids=[*LIGHTS][::-1])
@first("camera", ["pinhole", "orthographic"])
def test_both_modes_equal_finite_differences(camera, light):
    gbuffer = make_gbuffer(3, 3, 4)
    camera = make_camera(camera, 3, 4)
    rng = np.random.default_rng(0)
    weight = rng.normal(size=(3, 4, 3))
    arguments, others = eqx.partition((gbuffer, camera, light), eqx.is_inexact_array)

    def score(arguments):
        return jnp.sum(weight * relight.shade(*eqx.combine(arguments, others)))

    leaves, tree = jax.tree.flatten(arguments)
    leaves = [np.array(leaf) for leaf in leaves]

    def oracle(which, index, step):
        moved = [leaf.copy() for leaf in leaves]
        moved[which][index] += step
        return np.sum(weight * loop(*eqx.combine(jax.tree.unflatten(tree, moved), others)))

    along = jax.tree.map(lambda leaf: rng.normal(size=leaf.shape), arguments)
    pushed = lambda arguments: jax.jvp(score, (arguments,), (along,))[1]
    both = jax.jit(lambda arguments: (jax.grad(score)(arguments), pushed(arguments)))
    reverse, forward = both(arguments)
    still = set()
    for which, (path, slopes) in enumerate(jax.tree.leaves_with_path(reverse)):
        expected = np.zeros_like(leaves[which])
        for index in np.ndindex(expected.shape):
            ends = [oracle(which, index, step) for step in (1e-6, -1e-6)]
            expected[index] = (ends[0] - ends[1]) / 2e-6
        np.testing.assert_allclose(slopes, expected, rtol=1e-6, atol=1e-7)
        if np.abs(expected).max() < 1e-5:
            still.add(path[-1].name)
    products = jax.tree.map(np.vdot, reverse, along)
    np.testing.assert_allclose(forward, sum(jax.tree.leaves(products)), rtol=1e-10)
    if isinstance(light, PointLight | SpotLight):
        assert still == {"color", "ambient"}


@pytest.mark.parametrize("shader", [1, 2])
def test_sharp_highlights_and_narrow_cones_in_float32(shader):
    """Where 1e-7 of a cosine, one rounding, is 2e-3 of the image."""
    width = 12
    angles = np.linspace(0.001, 0.02, width)[None]
    one = np.ones((1, width, 3))
    gbuffer = GBuffer(
        **dict.fromkeys(REFLECTANCES, one) | {"diffuse": 0 * one},
        shader=np.full((1, width), shader),
        normal=np.stack([np.sin(angles), 0 * angles, -np.cos(angles)], axis=-1),
        depth=one[..., 0],
        roughness=0.01 * one[..., 0],
    )
    camera = OrthographicCamera(1e3, [0, 0.5], np.eye(4))
    for light in (sun(0, 0, 1), SpotLight([0, 0, 0], [0, 0, 1], [1, 1, 1], 0.002, 0.014)):
        result = relight.shade(cast(gbuffer, np.float32), camera, light)
        expected = loop(gbuffer, camera, light)
        np.testing.assert_allclose(result, expected, rtol=2e-4, atol=1e-7)


FIELDS = ("ambient", "diffuse", "specular", "normal", "depth", "roughness")


@jax.jit
def image_and_slopes(gbuffer, camera, lights):
    """An image and the derivatives of its sum in all that makes it."""
    arguments, others = eqx.partition((gbuffer, camera, lights), eqx.is_inexact_array)
    image = lambda arguments: relight.render(*eqx.combine(arguments, others))
    out, pull = jax.vjp(image, arguments)
    return out, *pull(jnp.ones_like(out))[0]


@pytest.mark.parametrize("shader", [0, 1, 2])
@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.full
def test_a_nan_stays_in_its_pixel_and_is_not_hidden(field, shader):
    gbuffer = make_gbuffer(5)
    pixel = tuple(np.argwhere(np.asarray(gbuffer.shader) == shader)[0])
    elsewhere = np.ones((7, 9), bool)
    elsewhere[pixel] = False
    select = lambda gbuffer: getattr(gbuffer, field)
    wrong = eqx.tree_at(select, gbuffer, select(gbuffer).at[pixel].set(jnp.nan))
    rest = make_camera("pinhole", 7, 9), list(LIGHTS.values())
    good, bad = (image_and_slopes(gbuffer, *rest)[:2] for gbuffer in (gbuffer, wrong))
    if field == "depth":  # A hole, where there is nothing to light.
        np.testing.assert_array_equal(bad[0][pixel], 0)
    else:
        is_read = shader > 0 or field not in ("specular", "roughness")
        assert np.isnan(bad[0][pixel]).all() == is_read
    for one, other in zip(jax.tree.leaves(good), jax.tree.leaves(bad), strict=True):
        assert np.isfinite(one).all()
        assert np.array_equal(one[elsewhere], other[elsewhere])


@pytest.mark.full
def test_background_is_black_whatever_it_holds():
    gbuffer = make_gbuffer(6)
    nothing = np.asarray(gbuffer.shader) == -1

    def rubbish(leaf):
        where = nothing if leaf.ndim == 2 else nothing[..., None]
        return jnp.where(where, jnp.nan, leaf) if leaf.dtype == float else leaf

    gbuffer = jax.tree.map(rubbish, gbuffer)
    result = image_and_slopes(gbuffer, make_camera("pinhole", 7, 9), list(LIGHTS.values()))
    assert np.all(result[0][nothing] == 0)
    assert np.all(result[0][~nothing] > 0)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(result))


@pytest.mark.parametrize("hole", [0.0, -1.0, np.nan, -np.inf, np.inf])
def test_a_hole_in_depth_is_black_and_no_other_pixel_knows(hole):
    gbuffer, rest = make_gbuffer(6), (make_camera("pinhole", 7, 9), list(LIGHTS.values()))
    missing = np.zeros((7, 9), bool)
    missing[2:4, 3:7] = True
    depth = np.where(missing, hole, gbuffer.depth)
    holed = eqx.tree_at(lambda gbuffer: gbuffer.depth, gbuffer, depth)
    (good, *_), (found, slopes, *others) = (
        image_and_slopes(gbuffer, *rest) for gbuffer in (gbuffer, holed)
    )
    np.testing.assert_array_equal(found, np.where(missing[..., None], 0, good))
    np.testing.assert_array_equal(np.asarray(slopes.depth)[missing], 0)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((slopes, others)))


@first("light", LIGHTS.values(), ids=LIGHTS.keys())
def test_visibility_multiplies(light):
    gbuffer, camera = make_gbuffer(1), make_camera("pinhole", 7, 9)
    nothing = np.asarray(gbuffer.shader) == -1
    visibility = np.where(nothing, np.nan, np.random.default_rng(0).random((7, 9)))
    image = lambda light, visibility: relight.shade(gbuffer, camera, light, visibility)
    plain = np.asarray(relight.shade(gbuffer, camera, light))

    @jax.jit
    def value_and_slopes(light, visibility):
        result, pull = jax.vjp(image, light, visibility)
        return result, *pull(jnp.ones_like(result))

    result, slopes, slope = value_and_slopes(light, visibility)
    expected = np.where(nothing[..., None], 0, plain * visibility[..., None])
    np.testing.assert_allclose(result, expected, rtol=1e-13)
    np.testing.assert_allclose(slope, plain.sum(axis=-1), rtol=1e-13)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))


@each_camera
def test_render_is_the_sum_of_lights(camera):
    gbuffer, camera = make_gbuffer(2), make_camera(camera, 7, 9)
    more = PointLight([0.5, 0.5, 1], [1.0, 0.5, 0.2])
    lights = [more, *LIGHTS.values(), more]
    expected = sum(loop(gbuffer, camera, light) for light in lights)
    np.testing.assert_allclose(relight.render(gbuffer, camera, lights), expected, rtol=1e-10)
    # Light of three times the colour is three times the light.
    colors = lambda lights: [light.color for light in lights]
    brighter = eqx.tree_at(colors, lights, [3 * np.asarray(light.color) for light in lights])
    np.testing.assert_allclose(
        relight.render(gbuffer, camera, brighter), 3 * expected, rtol=1e-10
    )


@pytest.mark.full
def test_render_with_shadows_is_the_sum_of_shaded_lights():
    gbuffer, camera = make_gbuffer(2), make_camera("pinhole", 7, 9)
    rng = np.random.default_rng(2)
    lights = [*LIGHTS.values(), PointLight([0.5, 0.5, 1], [1.0, 0.5, 0.2])]
    nothing = np.asarray(gbuffer.shader) == -1
    # What is not seen at all has no say, not even as a NaN.
    dim = [np.where(nothing, np.nan, rng.uniform(0, 1, (7, 9))) for _ in lights]
    for visible in (dim, [None, *dim[1:]], [*dim[:-1], None]):
        pairs = zip(lights, visible, strict=True)
        each = [
            loop(gbuffer, camera, light) * (1 if v is None else np.nan_to_num(v)[..., None])
            for light, v in pairs
        ]
        image = relight.render(gbuffer, camera, lights, visibilities=visible)
        np.testing.assert_allclose(image, sum(each), rtol=1e-10)
    state = relight.start(gbuffer, camera, lights, visibilities=visible)
    np.testing.assert_allclose(state.image, image, rtol=1e-10)
    slope = jax.grad(lambda v: jnp.sum(relight.render(*scene, visibilities=[v, *dim[1:]])))
    scene = gbuffer, camera, lights
    found = slope(jnp.asarray(np.nan_to_num(dim[0])))
    np.testing.assert_allclose(found, loop(gbuffer, camera, lights[0]).sum(axis=-1), rtol=1e-10)


def test_no_lights_are_black():
    gbuffer = cast(make_gbuffer(0), np.float32)
    image = relight.render(gbuffer, make_camera("pinhole", 7, 9), [])
    assert (image.shape, image.dtype) == ((7, 9, 3), np.float32)
    assert not image.any()


@pytest.mark.full
def test_gradients_of_render_equal_finite_differences():
    arguments = make_gbuffer(4), make_camera("pinhole", 7, 9), list(LIGHTS.values())
    floats, shader = eqx.partition(arguments, eqx.is_inexact_array)
    rng = np.random.default_rng(0)
    along = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), floats)

    def total(step):
        moved = jax.tree.map(lambda leaf, direction: leaf + step * direction, floats, along)
        gbuffer, camera, lights = eqx.combine(moved, shader)
        return sum(loop(gbuffer, camera, light).sum() for light in lights)

    expected = (total(1e-6) - total(-1e-6)) / 2e-6
    _, *reverse = image_and_slopes(*arguments)
    products = jax.tree.map(jnp.vdot, tuple(reverse), along)
    np.testing.assert_allclose(sum(jax.tree.leaves(products)), expected, rtol=1e-7)
    image = lambda floats: relight.render(*eqx.combine(floats, shader))
    forward = jax.jit(lambda along: jax.jvp(image, (floats,), (along,))[1])(along)
    np.testing.assert_allclose(forward.sum(), expected, rtol=1e-7)


@pytest.mark.usefixtures("optimised")
@pytest.mark.full
def test_reverse_memory_does_not_grow_with_the_lights():
    size = 64
    gbuffer = make_gbuffer(0, size, size, background=False)
    camera = make_camera("pinhole", size, size)

    def memory(count):
        lights = [LIGHTS["point"]] * count
        program = image_and_slopes.lower(gbuffer, camera, lights).compile()
        return program.memory_analysis().temp_size_in_bytes

    # Thirty more lights cost less than one more image.
    assert memory(32) - memory(2) < size * size * 3 * 8


def test_the_program_does_not_grow_with_the_picture():
    def program(size):
        gbuffer = make_gbuffer(0, size, size)
        camera = make_camera("pinhole", size, size)
        return jax.make_jaxpr(relight.shade)(gbuffer, camera, LIGHTS["spot"]).pretty_print()

    small, large = program(8), program(320)
    assert large.count(" = ") == small.count(" = ")
    # The one loop is that of inverting the camera's 3x3 matrix.
    loops = [line for line in large.splitlines() if "while[" in line or "scan[" in line]
    assert not any("320" in line for line in loops)


@first(("dtype", "tolerance"), [(np.float32, 1e-4), (np.float16, 2e-2)])
def test_the_type_of_the_image_is_kept(dtype, tolerance):
    camera, lights = make_camera("pinhole", 7, 9), list(LIGHTS.values())
    gbuffer = make_gbuffer(1)
    image = relight.render(cast(gbuffer, dtype), camera, lights)
    assert image.dtype == dtype
    expected = sum(loop(gbuffer, camera, light) for light in lights)
    np.testing.assert_allclose(image, expected, rtol=tolerance, atol=tolerance)
    visible = np.ones((7, 9))
    assert relight.shade(cast(gbuffer, dtype), camera, lights[2], visible).dtype == dtype


@first("size", [(1, 1), (1, 5), (6, 1)])
def test_any_size_and_batches_of_lights(size):
    gbuffer, camera = make_gbuffer(0, *size, background=False), make_camera("pinhole", *size)
    brighter = jax.tree.map(lambda leaf: np.asarray(leaf) * 1.01, LIGHTS["spot"])
    lights = [LIGHTS["spot"], brighter]
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *lights)
    images = jax.vmap(lambda light: relight.shade(gbuffer, camera, light))(batch)
    expected = np.stack([loop(gbuffer, camera, light) for light in lights])
    np.testing.assert_allclose(images, expected, rtol=1e-10)
    images = jax.vmap(lambda light: relight.render(gbuffer, camera, [light, lights[0]]))(batch)
    np.testing.assert_allclose(images, expected + expected[0], rtol=1e-10)


def test_an_unknown_shader_is_named_or_black():
    with pytest.raises(ValueError, match=r"`GBuffer\(shader\)` must be -1, 0, 1, 2, 3 or 4"):
        relight.shade(one_pixel(5), FRONT, LIGHTS["ambient"])
    assert not jax.jit(relight.shade)(one_pixel(5), FRONT, LIGHTS["ambient"]).any()


def test_errors_name_the_argument():
    shade, render = inspect.unwrap(relight.shade), inspect.unwrap(relight.render)
    gbuffer, camera, light = make_gbuffer(0), make_camera("pinhole", 7, 9), LIGHTS["point"]
    kinds = "AmbientLight, DirectionalLight, PointLight, SpotLight, SphericalHarmonicsLight, "
    kinds += "EnvironmentLight"
    for visibility in (np.ones((9, 7)), np.ones((7, 9, 1)), 1.0):
        with pytest.raises(ValueError, match=r"`shade\(visibility\)` must have shape \(7, 9\)"):
            shade(gbuffer, camera, light, visibility)
    with pytest.raises(ValueError, match=r"`shade\(visibility\)` must be in \[0, 1\]"):
        shade(gbuffer, camera, light, np.full((7, 9), 255))
    with pytest.raises(ValueError, match=rf"`shade\(light\)` must be one of {kinds}, got str"):
        shade(gbuffer, camera, "sun")
    with pytest.raises(ValueError, match=r"`render\(lights\[1\]\)` must be one of .*, got int"):
        render(gbuffer, camera, [light, 3])
    with pytest.raises(
        ValueError, match=r"`render\(lights\)` must be a sequence .* PointLight"
    ):
        render(gbuffer, camera, light)
    edited = eqx.tree_at(lambda gbuffer: gbuffer.normal, gbuffer, gbuffer.normal[:-1])
    for visible, message in (
        ([], "` must hold an image or None for each of 1"),
        ([1.0], r"\[0\]` must have shape \(7, 9\)"),
    ):
        with pytest.raises(ValueError, match=rf"`render\(visibilities=...\){message}"):
            render(gbuffer, camera, [light], visibilities=visible)
    for call, lights in ((shade, light), (render, [])):
        with pytest.raises(
            ValueError, match=r"`GBuffer\(normal\)` must have shape \(7, 9, 3\)"
        ):
            call(edited, camera, lights)


@pytest.mark.full
def test_booleans_are_visibilities():
    gbuffer, camera = make_gbuffer(3), make_camera("pinhole", 7, 9)
    seen = np.random.default_rng(4).random((7, 9)) < 0.5
    for light in LIGHTS.values():
        image = relight.shade(gbuffer, camera, light, seen)
        np.testing.assert_array_equal(
            image, relight.shade(gbuffer, camera, light, seen.astype(float))
        )
        state = relight.start(gbuffer, camera, [light], visibilities=[seen])
        np.testing.assert_allclose(state.image, image, rtol=1e-12, atol=1e-15)
        edited = state.edit(0, light, ~seen).add(light, seen)
        plain = relight.shade(gbuffer, camera, light)
        np.testing.assert_allclose(edited.image, plain, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("wrong", [255.0, -0.5, np.inf])
def test_visibilities_out_of_range(wrong):
    gbuffer, camera = make_gbuffer(3), make_camera("pinhole", 7, 9)
    light, visibility = LIGHTS["point"], np.full((7, 9), 0.5)
    visibility[2, 3] = wrong
    message = r"`shade\(visibility\)` must be in \[0, 1\], got .* at \[2, 3\], one of 1"
    with pytest.raises(ValueError, match=message):
        inspect.unwrap(relight.shade)(gbuffer, camera, light, visibility)
    with pytest.raises(ValueError, match=r"`start\(visibilities=...\)\[0\]` must be in"):
        relight.start(gbuffer, camera, [light], visibilities=[visibility])
    # Traced it multiplies as it is.
    traced = jax.jit(lambda v: relight.shade(gbuffer, camera, light, v))(visibility)
    plain = np.asarray(relight.shade(gbuffer, camera, light))
    with np.errstate(invalid="ignore"):
        shown = (np.asarray(gbuffer.shader) >= 0)[..., None]
        expected = np.where(shown, plain * visibility[..., None], 0)
    np.testing.assert_allclose(traced, expected, rtol=1e-12)


@pytest.mark.parametrize("wrong", [2.0, -0.1, 1.5])
def test_roughness_out_of_range(wrong):
    fields = vars(make_gbuffer(5))
    roughness = np.full((7, 9), 0.5)
    roughness[1, 2] = wrong
    message = r"`GBuffer\(roughness\)` must be in \[0, 1\], got .* at \[1, 2\]"
    with pytest.raises(ValueError, match=message):
        GBuffer(**fields | {"roughness": roughness})
    state = relight.start(make_gbuffer(5), make_camera("pinhole", 7, 9), [])
    with pytest.raises(ValueError, match=r"`paint\(roughness=...\)` must be in \[0, 1\]"):
        state.paint(np.ones((7, 9), bool), roughness=wrong)


def test_a_traced_roughness_above_1_is_1():
    """The highlight of a roughness of 1 is as bright wherever it is: cosine to the 0."""
    camera, light = make_camera("pinhole", 7, 9), LIGHTS["directional"]

    @jax.jit
    def shaded(roughness):
        fields = vars(make_gbuffer(6)) | {"roughness": jnp.full((7, 9), roughness)}
        return relight.shade(GBuffer(**fields), camera, light)

    np.testing.assert_array_equal(shaded(2.0), shaded(1.0))
    slope = jax.jit(jax.jacfwd(shaded))
    assert np.abs(slope(1.0)).max() > 0.1
    np.testing.assert_array_equal(slope(2.0), 0)


@pytest.mark.full
def test_a_traced_cone_out_of_order_is_dark():
    gbuffer, camera = make_gbuffer(7), make_camera("pinhole", 7, 9)
    spot = LIGHTS["spot"]

    @jax.jit
    def shaded(inner, outer):
        light = SpotLight(spot.position, spot.direction, spot.color, inner, outer)
        return relight.shade(gbuffer, camera, light)

    assert np.abs(shaded(0.05, 0.7)).max() > 0
    for inner, outer in ((0.7, 0.05), (0.5, 0.5)):
        np.testing.assert_array_equal(shaded(inner, outer), 0)
        for slope in jax.jacrev(shaded, (0, 1))(inner, outer):
            assert np.isfinite(slope).all()
