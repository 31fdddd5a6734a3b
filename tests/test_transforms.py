"""Every public function of arrays against itself, under each of JAX's transforms.

Functions are found by themselves, their arguments by name in `EXAMPLES`, and the values of an
option by its `Literal` annotation. Values are checked elsewhere, against independent oracles.
"""

import dataclasses
import functools
import importlib
import inspect
import itertools
import pkgutil
from collections.abc import Callable
from typing import Any, Literal, get_args, get_origin

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfx
import jaxfx.shadow
from jaxfx._checks import WholeNumber
from tests.helpers.quick import optimised


# Not functions of arrays: the host side reads files and meshes; solvers, measurements and plans
# run Python until they are done. Each of these states what it can do in its own tests.
NOT_TRANSFORMED = {"scene", "exr", "io", "fit", "tradeoff", "budget"}

# Nor functions of images: they give parameters, or no floats at all.
NO_PICTURES = {"shadow.candidates", "shadow.light_cameras"}

# Options that a function hands to another one, with which they are tested.
HANDED_ON = {
    ("reproject.warp", "search"),
    ("reproject.blend", "search"),
    ("reproject.blend", "target"),
    ("reproject.choose", "target"),
}

# Options that a traced argument needs: the default serves concrete ones alone.
NEEDED = {
    ("blur.gaussian", "taps"): 9,
    # One per point of the transfer, not per pixel.
    ("relight.indirect", "visibilities"): lambda rng, size: [None, rng.uniform(0, 1, 5)],
}

# Searches that end off the surface whose derivative they take: it is not that of their error.
ROUGH = {"descent", "linear", "relief"}


def thin_lens(rng, size):
    return jaxfx.ThinLens(aperture=0.5, focus_distance=rng.uniform(1.9, 2.1), focal_pixels=20.0)


def focus_planes(rng, size):
    return jaxfx.FocusPlanes(near=0.9, focus=rng.uniform(1.9, 2.1), far=4.5, max_coc=5.0)


def iris(rng, size):
    # A vignetting of 0 has nothing below it: no difference quotient.
    shape = {"roundness": rng.uniform(0.3, 0.6), "squeeze": 0.8, "vignetting": 0.2}
    return jaxfx.dof.Iris(5, rng.uniform(0, 1), **shape)


def pinhole(rng, size):
    return jaxfx.PinholeCamera.from_fov(rng.uniform(0.9, 1.1), height=size[0], width=size[1])


def turned(rng, size):
    """A pinhole turned a little: no pixel of another looks at the centre of one of its own."""
    c, s = np.cos(0.07), np.sin(0.07)
    pose = np.array([[c, s * s, s * c, 0], [0, c, -s, 0], [-s, c * s, c * c, 0], [0, 0, 0, 1]])
    fov = rng.uniform(0.9, 1.1)
    return jaxfx.PinholeCamera.from_fov(
        fov, height=size[0], width=size[1], world_from_camera=pose
    )


def orthographic(rng, size):
    centre = np.array(size[::-1]) / 2
    return jaxfx.OrthographicCamera(rng.uniform(4, 5), centre, np.eye(4))


def ambient(rng, size):
    return jaxfx.AmbientLight(rng.uniform(0.5, 1, 3))


def directional(rng, size):
    return jaxfx.DirectionalLight([0.2, 0.3, 1.0], rng.uniform(0.5, 1, 3))


def point(rng, size):
    return jaxfx.PointLight([0.5, -1.0, 0.2], rng.uniform(0.5, 1, 3))


def spot(rng, size):
    color = rng.uniform(0.5, 1, 3)
    return jaxfx.SpotLight([0.5, -1.0, 0.2], [-0.1, 0.3, 1.0], color, 0.3, 0.9)


def harmonics(rng, size):
    return jaxfx.SphericalHarmonicsLight(rng.normal(size=(9, 3)))


def environment(rng, size):
    return jaxfx.EnvironmentLight(rng.uniform(0.1, 1, (8, 16, 3)))


def receivers(rng, size):
    """Points whose shadow-map pixels lie in the map, near it and behind the light."""
    u, v = (rng.uniform(-2, count + 2, size) for count in size[::-1])
    z = np.where(rng.uniform(size=size) < 0.1, -1, rng.uniform(1.1, 4, size))
    return jaxfx.shadow.Receivers(u, v, z, rng.uniform(0, 1, size))


def gbuffer(rng, size):
    normal = np.concatenate([rng.uniform(-0.4, 0.4, (*size, 2)), -np.ones((*size, 1))], axis=-1)
    return jaxfx.GBuffer(
        color=rng.uniform(0.1, 1, (*size, 3)),
        shader=rng.integers(-1, 4, size),
        ambient=rng.uniform(0.1, 1, (*size, 3)),
        diffuse=rng.uniform(0.1, 1, (*size, 3)),
        specular=rng.uniform(0.1, 1, (*size, 3)),
        normal=normal / np.linalg.norm(normal, axis=-1, keepdims=True),
        depth=rng.uniform(1.1, 4, size),
        roughness=rng.uniform(0.3, 0.9, size),
    )


def transfer(rng, size):
    """Five points in front of the pixels, and a matrix of rank 2."""
    normal = rng.normal(size=(5, 3)) * 0.3 + [0, 0, -1]
    return jaxfx.Transfer(
        receive=rng.uniform(0.1, 1, (*size, 2)),
        send=rng.uniform(0.1, 1, (2, 5)),
        position=rng.uniform(1, 2, (5, 3)),
        normal=normal / np.linalg.norm(normal, axis=-1, keepdims=True),
        diffuse=rng.uniform(0.1, 1, (5, 3)),
        exchange=rng.uniform(0.1, 0.2, (5, 5)),
    )


def ray_origins(rng, size):
    return rng.uniform(0, 1, (*size, 3)) * np.array([size[1], size[0], 1.0])


# Small examples by the parameter's name, several where it may be of several types. `rng` is
# seeded, `size` is the height and width. Arrays are traced; Python's own numbers are static.
EXAMPLES = {
    "image": [lambda rng, size: rng.uniform(0.1, 1, (*size, 3))],
    "reference": [lambda rng, size: rng.uniform(0.1, 1, (*size, 3))],
    "depth": [lambda rng, size: rng.uniform(1.1, 4, size)],
    "visibility": [lambda rng, size: rng.uniform(0, 1, size)],
    "mask": [lambda rng, size: np.ones(size, bool)],
    "gbuffer": [gbuffer],
    "transfer": [transfer],
    "shadow_map": [lambda rng, size: rng.uniform(1.1, 4, size)],
    "receivers": [receivers],
    "light_camera": [orthographic, pinhole],
    "origin": [ray_origins],
    "direction": [lambda rng, size: rng.normal(size=(*size, 3)) * 0.1 + [0, 0, 1]],
    "images": [lambda rng, size: [rng.uniform(0.1, 1, (*size, 3)) for _ in range(2)]],
    "depths": [lambda rng, size: [rng.uniform(1.95, 2.05, size) for _ in range(2)]],
    "normal": [lambda rng, size: rng.normal(size=(*size, 3))],
    "normal_offset": [lambda rng, size: np.array(rng.uniform(0.1, 0.2))],
    "bias": [lambda rng, size: np.array(rng.uniform(0.1, 0.2))],
    "slope_bias": [lambda rng, size: np.array(rng.uniform(0.1, 0.2))],
    "size": [lambda rng, size: 3],
    "dilation": [lambda rng, size: None, lambda rng, size: 2],
    "light_size": [lambda rng, size: np.array(rng.uniform(0.2, 0.3))],
    "exponents": [lambda rng, size: rng.uniform(2, 4, 2)],
    "min_variance": [lambda rng, size: np.array(rng.uniform(0.1, 0.2))],
    "camera": [pinhole, orthographic],
    "target": [pinhole, orthographic],
    "lens": [thin_lens, focus_planes],
    "iris": [None, iris],
    "light": [point, ambient, directional, spot, harmonics, environment],
    "lights": [lambda rng, size: [make(rng, size) for make in (ambient, point)]],
    "gbuffers": [lambda rng, size: [gbuffer(rng, size), gbuffer(rng, size)]],
    "cameras": [lambda rng, size: [pinhole(rng, size), orthographic(rng, size)]],
    "views": [lambda rng, size: rng.integers(0, 2, size)],
    "visibilities": [lambda rng, size: [None, rng.uniform(0, 1, size)]],
    "count": [lambda rng, size: 2],
    "gamma": [lambda rng, size: np.array(rng.uniform(1, 2))],
    "epsilon": [lambda rng, size: np.array(rng.uniform(1, 2))],
    "data_range": [lambda rng, size: np.array(rng.uniform(1, 2))],
    "max_coc": [lambda rng, size: 6.0],
    "sigma": [lambda rng, size: np.array(rng.uniform(1, 2))],
    "tap_weights": [lambda rng, size: rng.uniform(0.1, 1, 5)],
    "index": [lambda rng, size: np.array(rng.uniform(1.3, 1.6))],
    "bounces": [lambda rng, size: 2],
    "slices": [lambda rng, size: 3, lambda rng, size: "all"],
    "edge": [lambda rng, size: np.array(rng.uniform(1, 2))],
    "threshold": [lambda rng, size: np.array(rng.uniform(1, 2))],
    "behind": [
        lambda rng, size: (rng.uniform(0.1, 1, (*size, 3)), rng.uniform(4.1, 8, size)),
        "peel",
        None,
    ],
    "disparity": [lambda rng, size: rng.uniform(1.1, 4, size)],
    "distance": [lambda rng, size: rng.uniform(1.1, 4, size)],
    "scale": [lambda rng, size: np.array(rng.uniform(1, 2))],
    "shift": [lambda rng, size: np.array(rng.uniform(0.1, 0.2))],
    "focal_pixels": [lambda rng, size: np.array(rng.uniform(20, 30))],
    "baseline": [lambda rng, size: np.array(rng.uniform(0.1, 0.2))],
    "disparity_offset": [lambda rng, size: np.array(rng.uniform(0.1, 0.2))],
    "unit": [lambda rng, size: np.array(rng.uniform(1, 2))],
    "ramp": [lambda rng, size: np.array(rng.uniform(1, 2))],
    "softness": [lambda rng, size: np.array(rng.uniform(1, 2))],
}

# Examples of functions that take fewer types than others of that name.
OWN_EXAMPLES = {
    ("dof.layered", "alpha"): [None, lambda rng, size: rng.uniform(0.1, 0.9, size)],
    ("dof.peel", "behind"): [
        None,
        lambda rng, size: (rng.uniform(0.1, 1, (*size, 3)), rng.uniform(4.1, 8, size)),
    ],
    ("reproject.warp", "camera"): [turned],
    ("reproject.blend", "cameras"): [lambda rng, size: [turned(rng, size) for _ in range(2)]],
    ("reproject.choose", "cameras"): [lambda rng, size: [turned(rng, size) for _ in range(2)]],
}

# Choices that do not go together, which the function refuses by name.
REFUSED = {
    "dof.layered": lambda chosen: chosen["mixed"] == "split" and chosen["alpha"] is not None,
    "dof.scatter": lambda chosen: (
        (chosen["coverage"] == "indicator" and chosen["program"] != "segment_sum")
        or (chosen["iris"] is iris and chosen["program"] not in ("auto", "shift", "spans"))
    ),
    "shadow.edge_pcf": lambda chosen: (
        chosen["dilation"] is not EXAMPLES["dilation"][chosen["edges"] == "screen"]
    ),
}


@dataclasses.dataclass(frozen=True, eq=False)
class Case:
    """A function, and for each parameter an option's value or one of the examples.

    `is_option` says that it differs from another case by an option, not by a type of argument.
    """

    function: Any
    choice: dict
    is_option: bool

    def split(
        self,
        select=eqx.is_inexact_array,
        *,
        seed=0,
        size=(13, 11),
        dtype=np.float64,
        parameters=np.float64,
    ):
        """The function of its selected arrays alone, to arrays selected likewise; and those.

        `dtype` is that of images and matrices, `parameters` that of numbers and vectors.
        """

        def make(name, chosen):
            if not callable(chosen):
                return chosen
            return chosen(np.random.default_rng([seed, *name.encode()]), size)

        def cast(leaf):
            if not isinstance(leaf, np.ndarray | jax.Array):
                return leaf
            wanted = dtype if leaf.ndim >= 2 else parameters
            return jnp.asarray(leaf, wanted if leaf.dtype == np.float64 else leaf.dtype)

        arguments = {name: make(name, chosen) for name, chosen in self.choice.items()}
        selected, others = eqx.partition(jax.tree.map(cast, arguments), select)

        def call(selected):
            return eqx.filter(self.function(**eqx.combine(selected, others)), select)

        return call, selected


def _functions():
    """Every public function whose first argument is data that JAX can trace, by name.

    A function of a Python callable, as the multi-pass reference is, calls it outside of any
    transform; one of a plain number makes a static table.
    """
    found = {}
    for module in pkgutil.iter_modules(jaxfx.__path__):
        if module.name[0] == "_" or module.name in NOT_TRANSFORMED:
            continue
        face = importlib.import_module(f"jaxfx.{module.name}")
        for name in getattr(face, "__all__", ()):
            function = getattr(face, name)
            if inspect.isclass(function) or not callable(function):
                continue
            if f"{module.name}.{name}" in NO_PICTURES:
                continue
            first = next(iter(inspect.signature(function).parameters.values())).annotation
            is_array = first not in (int, float, str, WholeNumber)
            if is_array and get_origin(first) is not Callable:
                found[f"{module.name}.{name}"] = function
    return found


def _choices(name, parameter):
    """What a parameter may be given: the values of its `Literal`, or the examples of its name.

    An option without an example keeps its default, unless it is one that JAX could trace.
    """
    if get_origin(parameter.annotation) is Literal:
        return sorted(get_args(parameter.annotation), key=lambda v: v != parameter.default)
    if (name, parameter.name) in OWN_EXAMPLES:
        return OWN_EXAMPLES[name, parameter.name]
    is_array = "jaxtyping" in inspect.formatannotation(parameter.annotation)
    if parameter.name not in EXAMPLES:
        is_needed = is_array or parameter.default is parameter.empty
        return [] if is_needed else [parameter.default]
    may_be_left_out = is_array and parameter.default is None
    return EXAMPLES[parameter.name] + [None] * may_be_left_out


def _cases(name, function):
    """As few cases as hold every choice once, near the first ones; and what is left over."""
    parameters = inspect.signature(function).parameters.values()
    choices = {p.name: _choices(name, p) for p in parameters}
    choices = {p: v[:1] if (name, p) in HANDED_ON else v for p, v in choices.items()}
    choices |= {p: [NEEDED[name, p]] for p in choices if (name, p) in NEEDED}
    if missing := [f"an example for `{name}`" for name in choices if not choices[name]]:
        return {}, missing
    cases, missing = {}, {(p, i) for p, values in choices.items() for i in range(len(values))}
    rows = itertools.product(*(range(len(values)) for values in choices.values()))
    for row in sorted(rows, key=np.count_nonzero):
        new = missing.intersection(zip(choices, row, strict=True))
        chosen = {p: choices[p][i] for p, i in zip(choices, row, strict=True)}
        if new and not (name in REFUSED and REFUSED[name](chosen)):
            missing -= new
            varied = [chosen[p] for p, i in sorted(new) if i]
            labels = [
                f"{p}={getattr(chosen[p], '__name__', chosen[p])}" for p, i in sorted(new) if i
            ]
            is_option = not varied or not all(map(callable, varied))
            cases["-".join([name, *labels])] = Case(function, chosen, is_option)
    return cases, [f"an accepted call with `{p}={choices[p][i]!r}`" for p, i in sorted(missing)]


FUNCTIONS = _functions()
CASES, MISSING = {}, {}
for _name, _function in FUNCTIONS.items():
    _found, MISSING[_name] = _cases(_name, _function)
    CASES |= _found


def each(cases):
    """Parametrize by cases, so that a case's tests follow one another and share `program`.

    The quick form of the suite takes the first case of each function: its default options.
    """
    values = [
        pytest.param(case, id=name, marks=() if name in FUNCTIONS else pytest.mark.full)
        for name, case in cases.items()
    ]
    return pytest.mark.parametrize("case", values, scope="module")


@functools.lru_cache(maxsize=1)
def program(case):
    """The function of a case, compiled; as it is; and its arguments."""
    call, arguments = case.split(eqx.is_array)
    return jax.jit(call), call, arguments


def _normal(tree, seed=7):
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape), leaf.dtype), tree)


def _dot(one, other, vdot=np.vdot):
    leaves = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return sum((vdot(x, y) for x, y in leaves), 0.0)


def _assert_close(actual, expected, tolerance=1e-9):
    leaves = zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True)
    for x, y in leaves:
        np.testing.assert_allclose(x, y, rtol=tolerance, atol=tolerance)


def _assert_finite(tree):
    for leaf in jax.tree.leaves(tree):
        assert np.isfinite(leaf).all()


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_argument_and_choice_is_exercised(name):
    assert not MISSING[name], f"`{name}` needs {', '.join(MISSING[name])}"


@each(CASES)
@pytest.mark.full
def test_jit(case):
    """Compiled as a whole with little optimisation, and not as a whole with all of it."""
    compiled, call, arguments = program(case)
    found = compiled(arguments)
    if not case.is_option:  # Another type of argument goes through the same code.
        _assert_close(found, call(arguments))
        return
    with optimised():
        _assert_close(found, call(arguments))


@each(CASES)
@pytest.mark.full
def test_vmap_is_a_loop(case):
    compiled, call, one = program(case)
    _, two = case.split(eqx.is_array, seed=1)
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), one, two)
    loop = jax.tree.map(lambda *leaves: jnp.stack(leaves), compiled(one), compiled(two))
    _assert_close(jax.jit(jax.vmap(call))(batch), loop)


@each(CASES)
@pytest.mark.parametrize("parameters", [np.float32, np.float64])
@pytest.mark.full
def test_float32_stays_and_is_close_to_float64(case, parameters):
    call, arguments = case.split(dtype=np.float32, parameters=parameters)
    compiled, _, same = program(case)
    out = jax.jit(call)(arguments)
    # What is made of vectors alone keeps their type.
    has_image = any(leaf.ndim >= 2 for leaf in jax.tree.leaves(arguments))
    dtype = np.dtype(np.float32 if has_image else parameters)
    assert {leaf.dtype for leaf in jax.tree.leaves(out)} <= {dtype}
    _assert_close(out, eqx.filter(compiled(same), eqx.is_inexact_array), tolerance=1e-4)


def _quotient(call, arguments, along):
    """The difference quotient of a function's first result, in NumPy."""
    arguments, along = jax.device_get((arguments, along))

    def moved(step):
        at = jax.tree.map(lambda x, v: x + step * v, arguments, along)
        return jax.device_get(call(at)[0])

    return jax.tree.map(lambda a, b: (a - b) / 2e-6, moved(1e-6), moved(-1e-6))


@functools.lru_cache(maxsize=1)
def pulled(case):
    """A compiled function to the result, weights on it and their gradient; and arguments."""
    call, arguments = case.split()

    @jax.jit
    def pulled(arguments):
        out, pull = jax.vjp(call, arguments)
        weight = _normal(out, seed=8)
        return out, weight, pull(weight)[0]

    return pulled, call, arguments, _normal(arguments)


@each(CASES)
def test_reverse_mode_is_the_difference_quotient(case):
    backward, _, arguments, along = pulled(case)
    _, weight, slopes = backward(arguments)
    _assert_finite(slopes)
    if case.choice.get("search") not in ROUGH:
        product = _dot(weight, _quotient(backward, arguments, along))
        _assert_close(_dot(slopes, along), product, tolerance=1e-4)


@functools.lru_cache(maxsize=1)
def pushed(case):
    """A compiled function to the result and its tangent, and, for options, a nested gradient.

    That of an energy's derivative: a column of the Hessian, in the program of the tangent.
    """
    call, arguments = case.split()
    along = _normal(arguments)

    def slope(arguments):
        out, tangent = jax.jvp(call, (arguments,), (along,))
        return _dot(out, tangent, jnp.vdot), (out, tangent)

    if case.is_option:
        return jax.jit(jax.grad(slope, has_aux=True))
    return jax.jit(lambda arguments: (None, slope(arguments)[1]))


@each(CASES)
@pytest.mark.full
def test_forward_mode_is_reverse_mode_and_everywhere_the_difference_quotient(case):
    backward, _, arguments, along = pulled(case)
    forward = lambda arguments: pushed(case)(arguments)[1]
    out, tangent = forward(arguments)
    reverse_out, weight, slopes = backward(arguments)
    _assert_close(reverse_out, out)
    _assert_close(_dot(weight, tangent), _dot(slopes, along), tolerance=1e-8)
    if case.choice.get("search") not in ROUGH:
        _assert_close(tangent, _quotient(forward, arguments, along), tolerance=1e-5)


# What differs by a type of argument alone goes through the same code.
OPTIONS = {name: case for name, case in CASES.items() if case.is_option}


@each(OPTIONS)
@pytest.mark.full
def test_nested_gradient_is_finite(case):
    _, arguments = case.split()
    _assert_finite(pushed(case)(arguments)[0])


# A score of an image may need a whole window of it; an image may have any size.
PICTURES = {name: case for name, case in OPTIONS.items() if not name.startswith("metrics.")}


@each(PICTURES)
@pytest.mark.full
def test_one_row(case):
    call, arguments = case.split(size=(1, 7))

    @jax.jit
    def value_and_gradient(arguments):
        out, pull = jax.vjp(call, arguments)
        return out, pull(_normal(out))

    _assert_finite(value_and_gradient(arguments))
