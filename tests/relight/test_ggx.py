"""GGX against glTF's closed form pixel by pixel, a white furnace, and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import (
    AmbientLight,
    DirectionalLight,
    EnvironmentLight,
    GBuffer,
    OrthographicCamera,
    PinholeCamera,
    PointLight,
    SpotLight,
    exr,
    relight,
    scene,
)
from tests.cases.relight_views import FRONT
from tests.helpers.forms import first
from tests.helpers.quick import check_slopes


LIGHTS = {
    "point": PointLight([-0.6, -0.9, 0.2], [3.0, 2.0, 1.0]),
    "sun": DirectionalLight([0.3, 0.5, 2.0], [1.0, 2.0, 3.0]),
    "spot": SpotLight([0.4, -0.5, 0.1], [-0.4, 0.3, 2.0], [3.0, 4.0, 5.0], 0.05, 0.7),
}
SIZE = (4, 5)
CAMERA = PinholeCamera.from_fov(0.9, height=SIZE[0], width=SIZE[1])


def materials(rng, size=SIZE):
    """Color, metallic, roughness, normal and depth of surfaces that more or less face us."""
    normal = rng.normal((0, 0, -1), 0.4, (*size, 3))
    return (
        rng.uniform(0.1, 1, (*size, 3)),
        rng.permutation(np.linspace(0, 1, size[0] * size[1])).reshape(size),
        rng.uniform(0.15, 1, size),
        normal / np.linalg.norm(normal, axis=-1, keepdims=True),
        rng.uniform(1.5, 4, size),
    )


def gltf_brdf(color, metallic, roughness, normal, to_light, to_camera):
    """Appendix B.3 of glTF 2.0, for one pixel, in its own words and with its own pi."""
    halfway = (to_light + to_camera) / np.linalg.norm(to_light + to_camera)
    n_l, n_v, n_h, v_h = (
        float(a @ b)
        for a, b in (
            (normal, to_light),
            (normal, to_camera),
            (normal, halfway),
            (to_camera, halfway),
        )
    )
    alpha = roughness**2
    c_diff = color * (1 - metallic)
    f0 = 0.04 * (1 - metallic) + color * metallic
    fresnel = f0 + (1 - f0) * (1 - abs(v_h)) ** 5
    seen = lambda cosine: 1.0 if cosine > 0 else 0.0
    distribution = alpha**2 * seen(n_h) / (np.pi * (n_h * n_h * (alpha**2 - 1) + 1) ** 2)
    root = lambda cosine: np.sqrt(alpha**2 + (1 - alpha**2) * cosine * cosine)
    visibility = 0.5 / (abs(n_l) * root(n_v) + abs(n_v) * root(n_l))
    return (1 - fresnel) * c_diff / np.pi + fresnel * distribution * visibility


def loop(color, metallic, roughness, normal, depth, light, camera=CAMERA):
    """The image under one light, in float64."""
    image = np.zeros((*depth.shape, 3))
    inverse = np.linalg.inv(np.asarray(camera.intrinsics, np.float64))
    unit = lambda v: v / np.linalg.norm(v)
    for j, i in np.ndindex(depth.shape):
        point = inverse @ [i + 0.5, j + 0.5, 1] * depth[j, i]
        if isinstance(light, DirectionalLight):
            to_light, irradiance = unit(-np.asarray(light.direction)), np.asarray(light.color)
        else:
            offset = np.asarray(light.position) - point
            to_light, irradiance = unit(offset), np.asarray(light.color) / (offset @ offset)
        if isinstance(light, SpotLight):
            inner, outer = np.cos(float(light.inner_angle)), np.cos(float(light.outer_angle))
            s = (-to_light @ unit(np.asarray(light.direction)) - outer) / (inner - outer)
            s = np.clip(s, 0, 1)
            irradiance = irradiance * (3 * s**2 - 2 * s**3)
        n = unit(normal[j, i])
        if n @ to_light > 0:
            material = color[j, i], metallic[j, i], roughness[j, i]
            brdf = gltf_brdf(*material, n, to_light, unit(-point))
            # What a white Lambert surface shows is 1 / pi of what falls in.
            image[j, i] = np.pi * irradiance * brdf * (n @ to_light)
    return image


def image_of(color, metallic, roughness, normal, depth, light, camera=CAMERA):
    gbuffer = GBuffer.metallic_roughness(color, metallic, roughness, normal, depth)
    return relight.shade(gbuffer, camera, light)


@pytest.mark.parametrize("light", LIGHTS.values(), ids=LIGHTS)
def test_equals_the_closed_form(light):
    images = materials(np.random.default_rng(0))
    expected = loop(*images, light)
    assert (expected > 0).any(axis=-1).sum() > 10
    np.testing.assert_allclose(image_of(*images, light), expected, rtol=1e-11, atol=1e-14)


def test_float32_keeps_the_digits_of_a_sharp_highlight():
    """A roughness of 0.05, at the highlight, where N.H differs from 1 by 1e-6."""
    angles = np.linspace(0, 0.01, 12)[None]
    one = np.ones((1, 12))
    normal = np.stack([np.sin(angles), 0 * angles, -np.cos(angles)], axis=-1)
    images = np.full((1, 12, 3), 0.7), one, 0.05 * one, normal, one
    camera = PinholeCamera([[1e6, 0, 6], [0, 1e6, 0.5], [0, 0, 1]], np.eye(4))
    light = DirectionalLight([0, 0, 1], [1, 1, 1])
    expected = loop(*images, light, camera)
    single = [image.astype(np.float32) for image in images]
    np.testing.assert_allclose(image_of(*single, light, camera), expected, rtol=1e-4)


def test_ambient_light_sees_the_base_color():
    color, *rest = materials(np.random.default_rng(1))
    image = image_of(color, *rest, AmbientLight([1, 2, 3]))
    np.testing.assert_allclose(image, color * [1, 2, 3], rtol=1e-12)


@pytest.mark.parametrize("light", LIGHTS.values(), ids=LIGHTS)
def test_both_modes_equal_finite_differences(light):
    rng = np.random.default_rng(2)
    images, weight = materials(rng), rng.normal(size=(*SIZE, 3))
    images[1][images[1] == 0] = 0.5  # There and at 1 differences leave the range.
    images[1][images[1] == 1] = 0.5
    leaves, tree = jax.tree.flatten(jax.device_get((*images, light)))

    def score(arguments):
        return jnp.sum(weight * image_of(*arguments))

    arguments = jax.tree.unflatten(tree, leaves)
    along = jax.tree.map(lambda leaf: rng.normal(size=leaf.shape), arguments)
    both = jax.jit(lambda a: (jax.grad(score)(a), jax.jvp(score, (a,), (along,))[1]))
    reverse, forward = both(arguments)
    still = []
    for which, slopes in enumerate(jax.tree.leaves(reverse)):
        expected = np.zeros(slopes.shape)
        for index in np.ndindex(expected.shape):
            ends = []
            for step in (1e-6, -1e-6):
                moved = [np.array(leaf) for leaf in leaves]
                moved[which][index] += step
                ends.append(np.sum(weight * loop(*jax.tree.unflatten(tree, moved))))
            expected[index] = (ends[0] - ends[1]) / 2e-6
        np.testing.assert_allclose(slopes, expected, rtol=1e-6, atol=1e-6)
        if np.abs(expected).max() < 1e-4:
            still.append(which)
    products = jax.tree.map(np.vdot, reverse, along)
    np.testing.assert_allclose(forward, sum(jax.tree.leaves(products)), rtol=1e-10)
    # A sun shines on the same normal the same at any depth along a ray.
    assert still == ([4] if isinstance(light, DirectionalLight) else [])


def one_pixel(metallic, roughness, facing, dtype=np.float32):
    """A pixel on the axis of `FRONT`, turned so that N.V is `facing`."""
    normal = [np.sqrt(1 - facing**2), 0, -facing]
    full = lambda value: np.full((1, 1), value, dtype)
    color, normal = np.full((1, 1, 3), 0.5, dtype), np.full((1, 1, 3), normal, dtype)
    return color, full(metallic), full(roughness), normal, full(1.0)


SUNS = {
    "frontal": (0, 0, 1),
    "grazing": (-1, 0, 1e-3),
    "behind": (0, 0, -1),
    "along": (1, 0, 0),
}


@jax.jit
def everything(arguments):
    """An image, its derivatives in all that makes it, and theirs along one direction."""
    score = lambda arguments: jnp.sum(image_of(*arguments, FRONT))
    along = jax.tree.map(lambda leaf: jnp.cos(7 * leaf + 1), arguments)
    return jax.jvp(jax.value_and_grad(score), (arguments,), (along,))


@pytest.mark.parametrize("sun", SUNS)
def test_finite_where_the_material_or_the_angle_ends(sun):
    """In float32: roughness 0, metallic 0 and 1, camera and light in the surface's plane."""
    for metallic in (0, 1):
        for roughness in (0, 1e-3, 1):
            for facing in (1.0, 1e-3, 0.0, -0.5):
                light = DirectionalLight(SUNS[sun], [4, 8, 12])
                arguments = (*one_pixel(metallic, roughness, facing), light)
                arguments = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), arguments)
                found = everything(arguments)
                wrong = [leaf for leaf in jax.tree.leaves(found) if not np.isfinite(leaf).all()]
                assert not wrong, (metallic, roughness, facing, wrong)


def test_a_roughness_below_the_least_counts_as_the_least():
    light = DirectionalLight([0, 0.001, 1], [1, 1, 1])
    least = np.asarray(image_of(*one_pixel(1.0, 0.01, 1.0, float), light, FRONT))
    assert least.max() > 1e3
    np.testing.assert_array_equal(
        image_of(*one_pixel(1.0, 0.0, 1.0, float), light, FRONT), least
    )


_suns = jax.jit(
    jax.vmap(
        lambda pixel, shader, way: relight.shade(
            with_shader(GBuffer.metallic_roughness(*pixel), shader),
            OrthographicCamera(1.0, [0.5, 0.5], np.eye(4)),
            DirectionalLight(-way, jnp.ones(3)),
        )[0, 0, 0],
        in_axes=(None, None, 0),
    )
)


def furnace(facing, roughness, metallic, color, count=96, shader=3):
    """The share of white light from all sides that a pixel returns, by many suns.

    The ways are spread by GGX's own distribution of halfway vectors and by the cosine, so that
    sharp lobes are met (Veach 1995, the balance heuristic).
    """
    alpha = max(roughness, 0.01) ** 2
    ratio = (np.arange(count) + 0.5) / count
    # Denser at both ends, where the integrand is steep.
    weight = np.tile(6 * ratio * (1 - ratio), 2 * count)
    u, angle = np.meshgrid(ratio * ratio * (3 - 2 * ratio), 2 * np.pi * ratio)

    def about_z(z):
        across = np.sqrt(np.maximum(1 - z**2, 0))
        return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=-1)

    to_camera = np.array([np.sqrt(1 - facing**2), 0, facing])
    halfway = about_z(np.sqrt((1 - u) / (1 + (alpha**2 - 1) * u)))
    mirrored = 2 * (halfway @ to_camera)[..., None] * halfway - to_camera
    ways = np.concatenate([mirrored, about_z(np.sqrt(1 - u))]).reshape(-1, 3)
    cosine = ways[:, 2]
    halfway = (ways + to_camera) / np.linalg.norm(ways + to_camera, axis=-1, keepdims=True)
    n_h, v_h = halfway[:, 2], halfway @ to_camera
    density = alpha**2 / (np.pi * (n_h**2 * (alpha**2 - 1) + 1) ** 2) * n_h / (4 * v_h)
    density = (density + np.maximum(cosine, 0) / np.pi) / 2
    solid_angle = np.where(cosine > 0, weight / density, 0) / len(ways)
    # From the surface's axes to those of a camera that looks along z.
    axes = np.stack([[-facing, 0, to_camera[0]], [0, 1, 0], -to_camera])
    pixel = [image.astype(float) for image in one_pixel(metallic, roughness, 1.0)]
    pixel[0], pixel[3] = np.full((1, 1, 3), color), axes[:, 2][None, None]
    # A sun of radiance 1 and solid angle w shows w / pi of a white Lambert surface.
    number = np.full((1, 1), shader)
    shown = np.asarray(_suns(pixel, number, ways @ axes.T))
    return float(np.sum(shown * solid_angle) / np.pi)


@pytest.mark.parametrize("roughness", [0.0, 0.1, 0.3, 0.6, 1.0])
def test_a_white_furnace_returns_no_more_than_falls_in(roughness):
    """A white metal; of a smooth one nearly all comes back, of a rough one less: the paths that
    meet the surface twice are not in the model."""
    found = [furnace(facing, roughness, 1.0, 1.0) for facing in (0.05, 0.2, 0.5, 1.0)]
    assert max(found) < 1.001
    assert min(found) > (0.85 if roughness <= 0.3 else 0.3)
    # A dielectric, black and white, seen from above.
    assert furnace(1.0, roughness, 0.0, 0.0) < 0.05
    assert 0.95 < furnace(1.0, roughness, 0.0, 1.0) < 1.001


@first("roughness", [0.1, 0.0, 0.05, 0.2, 0.35, 0.5, 0.7, 1.0])
def test_a_furnace_of_shader_4_returns_no_more_than_falls_in_at_any_angle(roughness):
    """White, of any metallic: by suns, and all of it for a dielectric, whose diffuse part gets
    what the highlight leaves."""
    for facing in (0.02, 0.03, 0.06, 0.1, 0.2, 0.35, 0.5, 0.7, 0.85, 1.0):
        for metallic in (0.0, 0.5, 1.0):
            found = furnace(facing, roughness, metallic, 1.0, count=128, shader=4)
            assert found < 1.001, (facing, metallic)
            if metallic == 0:
                assert found > 0.995, facing


def test_shader_4_is_gltf_s_highlight_and_what_it_leaves():
    """A white surface in a white room shows exactly white; a metal is the same as glTF's."""
    color, _, roughness, normal, depth = materials(np.random.default_rng(8))
    room = EnvironmentLight(np.ones((4, 8, 3)))
    make = lambda color, metallic, shader: with_shader(
        GBuffer.metallic_roughness(color, np.full(SIZE, metallic), roughness, normal, depth),
        np.full(SIZE, shader),
    )
    white = relight.shade(make(np.ones((*SIZE, 3)), 0.0, 4), CAMERA, room)
    np.testing.assert_allclose(white, 1, rtol=1e-12)
    for light in LIGHTS.values():
        metals = [relight.shade(make(color, 1.0, n), CAMERA, light) for n in (3, 4)]
        np.testing.assert_allclose(*metals, rtol=1e-12)
        black = [relight.shade(make(0 * color, 0.0, n), CAMERA, light) for n in (3, 4)]
        np.testing.assert_allclose(*black, rtol=1e-12)


def test_slopes_of_shader_4():
    rng = np.random.default_rng(9)
    color, _, _, normal, depth = materials(rng)
    # Amid cells of the table, at whose borders its slope jumps.
    roughness = (rng.integers(8, 30, SIZE) + 0.4) / 32
    weight = rng.normal(size=(*SIZE, 3))

    def score(color, roughness, specular, light):
        one = jnp.full(SIZE, 0.5)
        gbuffer = GBuffer.metallic_roughness(color, one, roughness, normal, depth)
        fields = vars(gbuffer) | {"specular": specular, "shader": np.full(SIZE, 4)}
        return jnp.sum(weight * relight.shade(GBuffer(**fields), CAMERA, light))

    arguments = color, roughness, 0.5 * color, LIGHTS["spot"]
    arguments = jax.tree.map(jnp.asarray, arguments)
    check_slopes(score, arguments, rtol=1e-5, atol=1e-5, eps=1e-6)


@pytest.mark.parametrize("shader", [3, 4])
def test_an_edit_is_a_fresh_picture_and_paint_reaches_ggx(shader):
    rng = np.random.default_rng(3)
    color, metallic, roughness, normal, depth = materials(rng)
    gbuffer = GBuffer.metallic_roughness(color, metallic, roughness, normal, depth)
    gbuffer = with_shader(gbuffer, np.full(SIZE, shader))
    lights = [LIGHTS["point"], LIGHTS["sun"], AmbientLight([0.1, 0.2, 0.3])]
    state = relight.start(gbuffer, CAMERA, lights)
    np.testing.assert_allclose(state.image, relight.render(gbuffer, CAMERA, lights), rtol=1e-12)
    edited = state.edit(0, PointLight([0.3, 0.2, 0.4], [5.0, 1.0, 2.0]))
    fresh = relight.render(gbuffer, CAMERA, edited.lights)
    np.testing.assert_allclose(edited.image, fresh, rtol=1e-12)
    every = np.ones(SIZE, bool)
    painted = state.paint(every, specular=np.full(3, 0.3), roughness=0.4)
    fields = vars(gbuffer) | {
        "specular": np.full((*SIZE, 3), 0.3),
        "roughness": np.full(SIZE, 0.4),
    }
    fresh = relight.render(GBuffer(**fields), CAMERA, lights)
    np.testing.assert_allclose(painted.image, fresh, rtol=1e-12)


def test_other_shaders_do_not_change_beside_it():
    """A cache of all models is one of each, pixel by pixel, bit by bit in the same program."""
    rng = np.random.default_rng(4)
    gbuffer = GBuffer.metallic_roughness(*materials(rng))
    shader = rng.permutation(20).reshape(SIZE) % 5
    with_all = jax.jit(lambda s: relight.shade(with_shader(gbuffer, s), CAMERA, LIGHTS["spot"]))
    mixed = np.asarray(with_all(shader))
    for number in range(5):
        alone = relight.shade(
            with_shader(gbuffer, np.full(SIZE, number)), CAMERA, LIGHTS["spot"]
        )
        at = shader == number
        np.testing.assert_allclose(mixed[at], np.asarray(alone)[at], rtol=1e-12, atol=1e-15)


def with_shader(gbuffer, shader):
    return GBuffer(**vars(gbuffer) | {"shader": shader})


def test_files_keep_it(tmp_path):
    gbuffer = GBuffer.metallic_roughness(
        *(image.astype(np.float32) for image in materials(np.random.default_rng(5)))
    )
    exr.write_gbuffer(tmp_path / "a.exr", gbuffer, camera=CAMERA)
    read, camera = exr.read_gbuffer(tmp_path / "a.exr")
    for one, other in zip(jax.tree.leaves(gbuffer), jax.tree.leaves(read), strict=True):
        np.testing.assert_array_equal(one, other)
    light = LIGHTS["point"]
    np.testing.assert_array_equal(
        relight.shade(read, camera, light), relight.shade(gbuffer, CAMERA, light)
    )


def test_a_gltf_file_shines_as_it_says(tmp_path):
    """Numbers of a file to a picture: a quad of one material, against the closed form."""
    trimesh = pytest.importorskip("trimesh")
    material = trimesh.visual.material.PBRMaterial(
        baseColorFactor=[51, 102, 255, 255], metallicFactor=0.25, roughnessFactor=0.5
    )
    quad = np.array([[-4, -3, 0], [4, -3, 0], [4, 3, 0], [-4, 3, 0]], float)
    visual = trimesh.visual.TextureVisuals(uv=np.zeros((4, 2)), material=material)
    mesh = trimesh.Trimesh(quad, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)
    mesh.export(tmp_path / "quad.glb")
    camera = PinholeCamera.look_at(
        [0.4, 0.2, 3], [0, 0, 0], up=[0, 1, 0], fov_y=0.9, height=SIZE[0], width=SIZE[1]
    )
    gbuffer = scene.gbuffer(
        scene.load(tmp_path / "quad.glb"),
        camera,
        height=SIZE[0],
        width=SIZE[1],
        backend="embree",
    )
    np.testing.assert_array_equal(gbuffer.shader, 3)
    sun = DirectionalLight([-0.2, 0.1, -1.0], [1.0, 1.0, 1.0])
    image = np.asarray(relight.shade(gbuffer, camera, sun))
    points = np.asarray(camera.points(np.asarray(gbuffer.depth, float)))
    eye = np.asarray(camera.world_from_camera)[:3, 3]
    for j, i in np.ndindex(SIZE):
        unit = lambda v: v / np.linalg.norm(v)
        to_light = unit(-np.asarray(sun.direction))
        color, normal = np.array([0.2, 0.4, 1.0]), np.array([0, 0, 1.0])
        brdf = gltf_brdf(color, 0.25, 0.5, normal, to_light, unit(eye - points[j, i]))
        np.testing.assert_allclose(image[j, i], np.pi * brdf * (normal @ to_light), rtol=1e-4)


def test_errors_name_the_argument():
    color, metallic, roughness, normal, depth = materials(np.random.default_rng(6))
    make = GBuffer.metallic_roughness
    with pytest.raises(
        ValueError, match=r"`GBuffer.metallic_roughness\(metallic\)` must be in"
    ):
        make(color, metallic + 0.1, roughness, normal, depth)
    with pytest.raises(
        ValueError, match=r"`GBuffer.metallic_roughness\(roughness\)` must be in"
    ):
        make(color, metallic, roughness + 1, normal, depth)
    with pytest.raises(ValueError, match=r"`GBuffer.metallic_roughness\(color\)` must have"):
        make(metallic, metallic, roughness, normal, depth)
    with pytest.raises(ValueError, match=r"`Material\(shader=...\)` must be one of"):
        scene.Material(shader="phong")


@pytest.mark.usefixtures("optimised")
def test_a_light_of_ggx_costs_at_most_half_more_than_one_of_blinn():
    """By the operations of the compiled programs; of which a GGX cache's also serves Blinn."""
    size = (64, 64)
    rng = np.random.default_rng(7)
    camera = PinholeCamera.from_fov(0.9, height=64, width=64)
    single = [image.astype(np.float32) for image in materials(rng, size)]
    gbuffer = GBuffer.metallic_roughness(*single)

    def work(shader):
        cache = with_shader(gbuffer, np.full(size, shader))
        lamp = jax.tree.map(lambda leaf: leaf.astype(np.float32), LIGHTS["point"])
        shade = jax.jit(lambda light: relight.shade(cache, camera, light))
        cost = shade.lower(lamp).compile().cost_analysis()
        return cost["flops"] + cost.get("transcendentals", 0)

    blinn, ggx = work(2), work(3)
    print(f"operations a pixel: Blinn {blinn / 4096:.0f}, GGX {ggx / 4096:.0f}")
    assert ggx < 1.5 * blinn
