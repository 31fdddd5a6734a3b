"""Every public array and number: wrong types raise errors with the name, others are accepted.

Functions are found by their entry in `CALLS`, a good call; `test_no_function_is_forgotten` asks
for one of each. A kind is tried on every argument: on those that arrays are read of, all of
`WRONG`; on those that objects are asked of, numbers in their place and batches of them.
"""

import functools as ft
import importlib
import inspect
import pkgutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfx
from jaxfx import (
    AmbientLight,
    DirectionalLight,
    EnvironmentLight,
    FocusPlanes,
    GBuffer,
    OrthographicCamera,
    PinholeCamera,
    PointLight,
    SphericalHarmonicsLight,
    SpotLight,
    ThinLens,
    Transfer,
    _arguments,
    blur,
    budget,
    depth,
    dof,
    fit,
    metrics,
    relight,
    reproject,
    shadow,
)


SIZE = (12, 16)
RNG = np.random.default_rng(0)
IMAGE = RNG.uniform(0.2, 1, (*SIZE, 3))
DEPTH = RNG.uniform(2.0, 2.2, SIZE)
CAMERA = PinholeCamera.from_fov(0.9, height=SIZE[0], width=SIZE[1])
FLAT = OrthographicCamera(6.0, [8.0, 6.0], np.eye(4))
LENS = ThinLens(0.1, 2.1, 30.0)
LIGHT = PointLight([0.0, -1.0, 0.0], [1.0, 1.0, 1.0])
NORMAL = np.broadcast_to([0.0, 0, -1], (*SIZE, 3))
ROUGH = np.full(SIZE, 0.5)
SHADER = np.full(SIZE, 2)
CACHE = GBuffer(IMAGE, SHADER, IMAGE, IMAGE, IMAGE, NORMAL, DEPTH, ROUGH)
MAP = np.full((8, 8), 3.0)
SEEN = shadow.receivers(DEPTH, CAMERA, FLAT)
TRANSFER = Transfer(
    np.ones((*SIZE, 2)), np.ones((2, 5)), *(np.ones((5, 3)) for _ in range(3)), np.ones((5, 5))
)
RAYS = np.broadcast_to([4.0, 4.0, 0.0], (2, 3)), np.broadcast_to([0.0, 0, 1], (2, 3))
STATE = relight.start(CACHE, CAMERA, [LIGHT])
LIT = np.ones(SIZE)
MOVING = shadow.MovingShadow(
    MAP,
    PinholeCamera([[8, 0, 4], [0, 8, 4], [0, 0, 1]], np.eye(4)),
    CACHE,
    CAMERA,
    softness=0.1,
)


def _moving_shadow(**arguments):
    """An instance made without jaxtyping's check of `__init__`."""
    made = object.__new__(type("Bare", (), {}))
    inspect.unwrap(shadow.MovingShadow.__init__)(made, **arguments)
    return [made.occluders, made.receivers]


QUIET = {"progress": False, "throw": False, "max_steps": 1}
PAIR = {"images": [IMAGE], "depths": [DEPTH], "cameras": [CAMERA], "target": CAMERA}
BLUR = {"image": IMAGE, "depth": DEPTH, "lens": LENS, "max_coc": 4.0}
SHADOWED = {"shadow_map": MAP, "receivers": SEEN, "bias": 0.1, "slope_bias": 0.1}

# Valid arguments of each function, by name.
CALLS = {
    "blur.gaussian": (blur.gaussian, {"image": IMAGE, "taps": 3, "passes": 1, "sigma": 0.7}),
    "blur.downsample": (blur.downsample, {"image": IMAGE, "taps": 2}),
    "blur.linear_taps": (blur.linear_taps, {"tap_weights": np.ones(5)}),
    "blur.binomial_weights": (blur.binomial_weights, {"taps": 3, "row": 4}),
    "metrics.psnr": (metrics.psnr, {"image": IMAGE, "reference": IMAGE / 2, "data_range": 1.0}),
    "metrics.ssim": (metrics.ssim, {"image": IMAGE, "reference": IMAGE / 2, "data_range": 1.0}),
    "dof.scatter": (dof.scatter, BLUR | {"gamma": 0.5, "epsilon": 1.0}),
    "dof.layered": (dof.layered, BLUR | {"threshold": 2.0}),
    "dof.peel": (dof.peel, BLUR | {"threshold": 2.0}),
    "dof.gather": (dof.gather, BLUR | {"taps": 5, "ramp": 1.0}),
    "dof.blend": (dof.blend, BLUR),
    "dof.depth_sorted": (dof.depth_sorted, BLUR | {"slices": 3}),
    "dof.separable": (dof.separable, BLUR | {"epsilon": 1.0}),
    "dof.anisotropic_diffusion": (dof.anisotropic_diffusion, BLUR | {"edge": 3.0}),
    "dof.implicit_diffusion": (dof.implicit_diffusion, BLUR | {"edge": 3.0}),
    "dof.accumulate": (
        ft.partial(dof.accumulate, lambda eye: IMAGE, progress=False),
        {"camera": CAMERA, "lens": LENS, "samples": 2, "seed": 1},
    ),
    "reproject.intersect": (
        reproject.intersect,
        {"depth": DEPTH, "origin": RAYS[0], "direction": RAYS[1], "max_steps": 9},
    ),
    "reproject.warp": (
        reproject.warp,
        {
            **{"image": IMAGE, "depth": DEPTH, "camera": CAMERA, "target": CAMERA},
            **{"hole_threshold": 0.1},
        },
    ),
    "reproject.blend": (reproject.blend, PAIR | {"hole_threshold": 0.1}),
    "reproject.choose": (
        reproject.choose,
        {n: v for n, v in PAIR.items() if n != "images"} | {"count": 1, "hole_threshold": 0.1},
    ),
    "shadow.receivers": (
        shadow.receivers,
        {
            **{"depth": DEPTH, "camera": CAMERA, "light_camera": FLAT},
            **{"normal": NORMAL, "normal_offset": 0.1},
        },
    ),
    "shadow.light_cameras": (
        shadow.light_cameras,
        {
            "light": LIGHT,
            "map_size": 8,
            "scene_center": np.zeros(3),
            "scene_radius": 2.0,
            "margin": 1,
        },
    ),
    "shadow.hard": (shadow.hard, SHADOWED),
    "shadow.prefiltered": (shadow.prefiltered, SHADOWED | {"size": 3}),
    "shadow.pcf": (shadow.pcf, SHADOWED | {"size": 3, "softness": 0.1}),
    "shadow.edge_pcf": (
        shadow.edge_pcf,
        SHADOWED | {"size": 3, "softness": 0.1, "dilation": 2, "edges": "screen"},
    ),
    "shadow.candidates": (
        shadow.candidates,
        SHADOWED | {"size": 3, "dilation": 2, "edges": "screen"},
    ),
    "shadow.pcss": (
        shadow.pcss,
        SHADOWED | {"light_camera": FLAT, "size": 3, "light_size": 0.1},
    ),
    "shadow.variance": (
        shadow.variance,
        SHADOWED | {"size": 3, "min_variance": 0.1, "exponents": np.array([8.0, 4.0])},
    ),
    "relight.shade": (
        relight.shade,
        {"gbuffer": CACHE, "camera": CAMERA, "light": LIGHT, "visibility": LIT},
    ),
    "relight.render": (relight.render, {"gbuffer": CACHE, "camera": CAMERA, "lights": [LIGHT]}),
    "relight.start": (
        relight.start,
        {"gbuffer": CACHE, "camera": CAMERA, "lights": [LIGHT], "visibilities": [LIT]},
    ),
    "relight.edit": (
        ft.partial(relight.RelightState.edit, STATE),
        {"i": 0, "light": LIGHT, "visibility": LIT},
    ),
    "relight.add": (
        ft.partial(relight.RelightState.add, STATE),
        {"light": LIGHT, "visibility": LIT},
    ),
    "relight.remove": (ft.partial(relight.RelightState.remove, STATE), {"i": 0}),
    "relight.paint": (
        ft.partial(relight.RelightState.paint, STATE),
        {"mask": np.ones(SIZE, bool), "color": np.ones(3), "roughness": 0.5}
        | {"diffuse": np.ones(3), "specular": np.ones(3)},
    ),
    "relight.synthesize": (
        relight.synthesize,
        {
            **{"gbuffers": [CACHE], "cameras": [CAMERA], "target": CAMERA, "depth": DEPTH},
            **{"tolerance": 0.1, "angle": 0.5},
        },
    ),
    "relight.choose": (
        relight.choose,
        {
            **{"gbuffers": [CACHE], "cameras": [CAMERA], "target": CAMERA, "depth": DEPTH},
            **{"count": 1, "tolerance": 0.1, "stride": 2},
        },
    ),
    "relight.fill_holes": (
        relight.fill_holes,
        {"gbuffer": CACHE, "views": np.ones(SIZE, int)},
    ),
    "relight.mirrored": (relight.mirrored, {"gbuffer": CACHE, "camera": CAMERA}),
    "relight.refracted": (
        relight.refracted,
        {"gbuffer": CACHE, "camera": CAMERA, "index": np.full(SIZE, 1.5)},
    ),
    "relight.fresnel": (
        relight.fresnel,
        {"gbuffer": CACHE, "camera": CAMERA, "index": np.full(SIZE, 1.5)},
    ),
    "relight.indirect": (
        relight.indirect,
        {
            "gbuffer": CACHE,
            "transfer": TRANSFER,
            "lights": [LIGHT],
            "visibilities": [np.ones(5)],
        },
    ),
    "relight.capture_normals": (
        lambda render: inspect.unwrap(relight.capture_normals)(lambda lights: render),
        {"render": IMAGE},
    ),
    "fit.dof": (
        ft.partial(fit.dof, **QUIET),
        {
            **{"reference": IMAGE, "image": IMAGE, "depth": DEPTH, "gamma": 1.0},
            **{"lens": ThinLens(0.1, 1.0, 60.0)},
            **{"epsilon": 1.0, "threshold": 1.0, "max_coc": 4.0},
        },
    ),
    "fit.camera": (
        ft.partial(fit.camera, **QUIET),
        {
            **{"reference": IMAGE, "image": IMAGE, "depth": DEPTH, "camera": CAMERA},
            **{"start": CAMERA, "hole_threshold": 0.1},
        },
    ),
    "fit.lights": (
        ft.partial(fit.lights, **QUIET),
        {
            **{"reference": IMAGE, "gbuffer": CACHE, "camera": CAMERA, "lights": [LIGHT]},
            **{"visibilities": [LIT], "rounds": 1},
        },
    ),
    "fit.focal_stack": (
        ft.partial(fit.focal_stack, throw=False),
        {
            **{"images": [IMAGE, IMAGE], "lenses": [LENS, ThinLens(0.1, 1.0, 60.0)]},
            **{"min_depth": 0.9, "max_depth": 4.0, "smoothness": 1.0, "max_steps": 0},
        },
    ),
    "shadow.MovingShadow": (
        _moving_shadow,
        {
            **{"shadow_map": MAP, "light_camera": CAMERA, "gbuffer": CACHE, "camera": CAMERA},
            **{"softness": 0.1, "size": 3},
        },
    ),
    "shadow.MovingShadow()": (
        ft.partial(shadow.MovingShadow.__call__, MOVING),
        {"light": LIGHT},
    ),
    "budget.dof": (
        budget.dof,
        {n: v for n, v in BLUR.items() if n != "max_coc"} | {"max_error": 0.1},
    ),
    "budget.shadow": (budget.shadow, SHADOWED | {"size": 3, "max_error": 0.1}),
    "budget.relight": (
        budget.relight,
        {
            **{"gbuffer": CACHE, "camera": CAMERA, "lights": [LIGHT], "max_error": 0.1},
            **{"visibilities": [LIT]},
        },
    ),
    "budget.reproject": (
        budget.reproject,
        {
            **{"images": [IMAGE], "depths": [DEPTH], "cameras": [CAMERA], "target": CAMERA},
            **{"height": 8, "width": 9, "max_error": 0.1},
        },
    ),
    "budget.accumulate": (
        ft.partial(budget.accumulate, lambda eye: IMAGE),
        {"camera": CAMERA, "lens": LENS, "max_error": 0.1},
    ),
    "depth.clean": (depth.clean, {"depth": DEPTH, "unit": 0.5}),
    "depth.from_disparity": (
        depth.from_disparity,
        {"disparity": DEPTH, "scale": 0.5, "shift": 0.1},
    ),
    "depth.from_stereo": (
        depth.from_stereo,
        {"disparity": DEPTH, "focal_pixels": 50.0, "baseline": 0.1, "disparity_offset": 0.0},
    ),
    "depth.from_ray_distance": (
        depth.from_ray_distance,
        {"distance": DEPTH, "camera": CAMERA},
    ),
    "depth.fill": (depth.fill, {"depth": DEPTH, "image": IMAGE}),
    "ThinLens": (ThinLens, {"aperture": 0.1, "focus_distance": 2.0, "focal_pixels": 30.0}),
    "ThinLens.from_disparity": (
        ThinLens.from_disparity,
        {"strength": 8.0, "focus_disparity": 0.5, "scale": 2.0, "shift": 0.1},
    ),
    "ThinLens.defocus": (ft.partial(ThinLens.defocus, LENS), {"depth": DEPTH}),
    "ThinLens.circle_of_confusion": (
        ft.partial(ThinLens.circle_of_confusion, LENS),
        {"depth": DEPTH},
    ),
    "dof.Iris": (
        dof.Iris,
        {
            **{"blades": 6, "rotation": 0.1, "roundness": 0.2, "squeeze": 0.9},
            **{"vignetting": 0.5, "profile": -0.5, "rings": 4},
        },
    ),
    "dof.Iris.open_share": (
        ft.partial(dof.Iris.open_share, dof.Iris(vignetting=0.5)),
        {"height": 4, "width": 5},
    ),
    "FocusPlanes": (FocusPlanes, {"near": 1.0, "focus": 2.0, "far": 3.0, "max_coc": 4.0}),
    "PinholeCamera": (
        PinholeCamera,
        {"intrinsics": CAMERA.intrinsics, "world_from_camera": np.eye(4)},
    ),
    "PinholeCamera.from_fov": (PinholeCamera.from_fov, {"fov_y": 0.9, "height": 4, "width": 5}),
    "PinholeCamera.look_at": (
        PinholeCamera.look_at,
        {
            **{"eye": np.zeros(3), "at": np.ones(3), "up": np.array([0.0, 1, 0])},
            **{"fov_y": 0.9, "height": 4, "width": 5},
        },
    ),
    "PinholeCamera.through_lens": (
        ft.partial(PinholeCamera.through_lens, CAMERA),
        {"offset": np.zeros(2), "focus_distance": 2.0},
    ),
    "PinholeCamera.project": (
        ft.partial(PinholeCamera.project, CAMERA),
        {"points": np.ones((4, 3))},
    ),
    "PinholeCamera.unproject": (
        ft.partial(PinholeCamera.unproject, CAMERA),
        {"pixels": np.ones((4, 2)), "depth": np.ones(4)},
    ),
    "PinholeCamera.points": (ft.partial(PinholeCamera.points, CAMERA), {"depth": DEPTH}),
    "PinholeCamera.rays": (ft.partial(PinholeCamera.rays, CAMERA), {"height": 4, "width": 5}),
    "OrthographicCamera": (
        OrthographicCamera,
        {"pixels_per_unit": 1.0, "center": np.zeros(2), "world_from_camera": np.eye(4)},
    ),
    "OrthographicCamera.project": (
        ft.partial(OrthographicCamera.project, FLAT),
        {"points": np.ones((4, 3))},
    ),
    "OrthographicCamera.unproject": (
        ft.partial(OrthographicCamera.unproject, FLAT),
        {"pixels": np.ones((4, 2)), "depth": np.ones(4)},
    ),
    "AmbientLight": (AmbientLight, {"color": np.ones(3)}),
    "DirectionalLight": (DirectionalLight, {"direction": np.ones(3), "color": np.ones(3)}),
    "SphericalHarmonicsLight": (SphericalHarmonicsLight, {"coefficients": np.ones((9, 3))}),
    "EnvironmentLight": (
        EnvironmentLight,
        {"image": np.ones((4, 8, 3)), "world_from_image": np.eye(3), "color": np.ones(3)},
    ),
    "PointLight": (PointLight, {"position": np.ones(3), "color": np.ones(3)}),
    "SpotLight": (
        SpotLight,
        {
            **{"position": np.ones(3), "direction": np.ones(3), "color": np.ones(3)},
            **{"inner_angle": 0.1, "outer_angle": 0.2},
        },
    ),
    "GBuffer": (GBuffer, dict(vars(CACHE))),
    "Transfer": (Transfer, dict(vars(TRANSFER))),
}

# Static arguments. Errors may name one differently, as it is passed to another function.
STATIC = {
    *("taps", "passes", "row", "samples", "seed", "max_steps", "count", "map_size", "margin"),
    *("size", "dilation", "stride", "rounds", "slices", "height", "width", "i"),
}
NUMBERS = {"max_coc", "hole_threshold", "max_error", "tolerance", "angle"}
NUMBERS |= {"min_depth", "max_depth", "smoothness"}
# Values of these are parameters of a lens of our own, `FocusPlanes(max_coc)`.
TRACED = {("FocusPlanes", "max_coc")}


def _bare(function):
    """The function without jaxtyping's check of its arguments."""
    if isinstance(function, ft.partial):
        return ft.partial(_bare(function.func), *function.args, **function.keywords)
    if inspect.ismethod(function):  # a class'
        return ft.partial(inspect.unwrap(function.__func__), function.__self__)
    return function if inspect.isclass(function) else inspect.unwrap(function)


def _is_array(name, argument, value):
    if (argument in STATIC | NUMBERS) and (name, argument) not in TRACED:
        return False
    return isinstance(value, np.ndarray | jax.Array | float)


WRONG = {
    "None": lambda x: None,
    "str": lambda x: "image.exr",
    "dict": lambda x: {"R": x, "G": x},
    "object": lambda x: np.asarray(x).astype(object),
    "masked": np.ma.masked_array,
    "strings": lambda x: np.asarray(x).astype(str),
    "ragged": lambda x: [[1.0], [1.0, 2.0]],
    "camera": lambda x: CAMERA,
    "complex": lambda x: 1j * np.asarray(x),
}
# Left out, these are something else.
MAY_BE_NONE = {
    "world_from_image",
    *(
        "bias",
        "slope_bias",
        "visibility",
        "sigma",
        "exponents",
        "exchange",
        "index",
        "softness",
        "normal",
        "color",
        "diffuse",
        "specular",
        "roughness",
    ),
}

ARRAYS = [
    (name, argument)
    for name, (_, arguments) in CALLS.items()
    for argument, value in arguments.items()
    if _is_array(name, argument, value)
]


@pytest.mark.parametrize(("name", "argument"), ARRAYS)
def test_what_is_no_array_is_named(name, argument):
    function, arguments = CALLS[name]
    for kind, make in WRONG.items():
        if kind == "None" and argument in MAY_BE_NONE:
            continue
        # In `depth`, masked pixels are missing, and an image is optional.
        may_be = kind == "masked" or (kind, argument) == ("None", "image")
        if name.startswith("depth.") and may_be:
            continue
        wrong = make(arguments[argument])
        with pytest.raises((ValueError, TypeError), match=r"^`") as caught:
            _bare(function)(**arguments | {argument: wrong})
        first = str(caught.value).split("` must")[0]
        assert argument in first, f"{kind}: {caught.value}"
        assert "jaxtyping" not in type(caught.value).__module__


# Functions that measure or search pass their arguments on to the effects.
# A fit or a plan compiles its programs at every call.
SLOW = ("fit.", "budget.")

DETERMINED = [each for each in ARRAYS if not each[0].startswith(SLOW)]


@pytest.mark.parametrize(("name", "argument"), DETERMINED)
@pytest.mark.full
def test_byte_orders_and_lists_are_read(name, argument):
    """Arguments that hold the same numbers give equal results, to the last bit."""
    function, arguments = CALLS[name]
    value = np.asarray(arguments[argument])
    expected = jax.tree.leaves(_bare(function)(**arguments))
    others = [value.astype(value.dtype.newbyteorder(">"))]
    if value.ndim < 3:
        others.append(value.tolist())
    for other in others:
        found = jax.tree.leaves(_bare(function)(**arguments | {argument: other}))
        for one, two in zip(found, expected, strict=True):
            np.testing.assert_array_equal(one, two)


COUNTS = [
    (name, argument)
    for name, (_, arguments) in CALLS.items()
    for argument in arguments
    if argument in STATIC | NUMBERS and (name, argument) not in TRACED
]


@pytest.mark.parametrize(("name", "argument"), COUNTS)
def test_static_numbers_are_whole_numbers_or_refused(name, argument):
    function, arguments = CALLS[name]
    call = _bare(function)
    for wrong in (True, np.True_, "3", [3], 3j, np.array([3, 3])):
        with pytest.raises(ValueError, match=rf"^`[\w.]*\(.*{argument}.*\)` must .*, got"):
            call(**arguments | {argument: wrong})
    if argument in STATIC:
        with pytest.raises(ValueError, match=rf"^`[\w.]*\(.*{argument}.*\)` must .*, got"):
            call(**arguments | {argument: 2.5})


@pytest.mark.parametrize(("name", "argument"), COUNTS)
@pytest.mark.full
def test_static_numbers_of_any_kind(name, argument):
    function, arguments = CALLS[name]
    call, given = _bare(function), arguments[argument]
    kinds = (np.int64, np.uint8) if argument in STATIC else (np.float32, np.float64)
    for kind in (*kinds, np.asarray, jnp.asarray):
        call(**arguments | {argument: kind(given)})


OBJECTS = [
    (name, argument)
    for name, (_, arguments) in CALLS.items()
    for argument, value in arguments.items()
    if isinstance(
        value, PinholeCamera | OrthographicCamera | ThinLens | PointLight | GBuffer | Transfer
    )
]


@pytest.mark.parametrize(("name", "argument"), OBJECTS)
def test_objects_of_other_kinds_and_batches(name, argument):
    function, arguments = CALLS[name]
    value = arguments[argument]
    for wrong in (0.1, None, "camera", IMAGE, {"a": 1}, type(value)):
        with pytest.raises(ValueError, match=rf"^`[\w.]*\({argument}.*\)` must be") as caught:
            _bare(function)(**arguments | {argument: wrong})
        assert ", got" in str(caught.value)
    if not isinstance(value, GBuffer | Transfer):
        batch = jax.tree.map(lambda x: jnp.stack([x, x]), value)
        with pytest.raises(ValueError, match=rf"\({argument}\)` must be one .*`jax.vmap`"):
            _bare(function)(**arguments | {argument: batch})


SEQUENCES = [
    (name, argument)
    for name, (_, arguments) in CALLS.items()
    for argument, value in arguments.items()
    if isinstance(value, list)
]


@pytest.mark.parametrize(("name", "argument"), SEQUENCES)
def test_sequences_and_what_is_in_them(name, argument):
    function, arguments = CALLS[name]
    for wrong in ("ab", {"a": 1}, 3, [0.5, "x"], [object()], ["x"]):
        with pytest.raises(ValueError, match=r"^`[\w.]*\(.*\)[^`]*` must .*, got ") as caught:
            _bare(function)(**arguments | {argument: wrong})
        assert argument.rstrip("s") in str(caught.value)


def test_check_camera_and_check_light():
    _arguments.check_camera("f(camera)", CAMERA)
    with pytest.raises(ValueError, match=r"`f\(camera\)` must be a PinholeCamera, got Ortho"):
        _arguments.check_camera("f(camera)", FLAT, PinholeCamera)
    with pytest.raises(ValueError, match=r"a PinholeCamera or an OrthographicCamera, got int"):
        _arguments.check_camera("f(camera)", 3)
    _arguments.check_lens("f(lens)", LENS)
    _arguments.check_light("f(light)", LIGHT)
    assert _arguments.check_lights("f(lights)", [LIGHT]) == (LIGHT,)
    with pytest.raises(
        ValueError, match=r"`f\(lights\[1\]\)` must be one of Ambient.*got None"
    ):
        _arguments.check_lights("f(lights)", [LIGHT, None])
    same = _arguments.check_gbuffer("f(gbuffer)", CACHE)
    np.testing.assert_array_equal(same.color, CACHE.color)


def test_no_function_is_forgotten():
    """Every public function of arrays, and every class, has valid arguments in `CALLS`."""
    host = {"scene", "exr", "io", "tradeoff", "sharding"}
    records = {"Plan", "Accumulation", "Choice", "Synthesis", "Hit", "Receivers", "Candidates"}
    records |= {"Lens", "Filled", "FilledCache", "LinearTaps", "Projection", "Rays"}
    for module in pkgutil.iter_modules(jaxfx.__path__):
        if module.name[0] == "_" or module.name in host:
            continue
        face = importlib.import_module(f"jaxfx.{module.name}")
        for name in face.__all__:
            value = getattr(face, name)
            is_result = name.endswith("Fit") or name in records | {"RelightState"}
            if callable(value) and not is_result:
                assert f"{module.name}.{name}" in CALLS or name in CALLS, name
