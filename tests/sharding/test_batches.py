"""Batches that are spread over eight devices along their first axis, effect by effect.

Those of `dof`, the most to compile, are in a file of their own, which another process runs.
"""

import importlib
import inspect
import pkgutil

import pytest

import jaxfx
from tests.helpers.fits import FITS
from tests.test_transforms import CASES, FUNCTIONS


QUICK = ("dof.gather", "shadow.edge_pcf")
MESHES = ("explicit", "auto", "shard_map")


# Public functions that no batch of images goes through, and why.
NO_BATCH = {
    # Files and tables of the host.
    *("exr.read", "exr.read_gbuffer", "exr.read_rgbd", "exr.write", "exr.write_gbuffer"),
    *("io.linear_from_srgb", "io.read_color", "io.read_depth", "io.read_png"),
    *("io.srgb_from_linear", "io.write_png", "blur.binomial_weights"),
    # Meshes, which OpenGL and Embree draw and trace on the host; rays and occlusion too.
    *("scene.default_camera", "scene.default_lights", "scene.depth", "scene.from_trimesh"),
    *("scene.gbuffer", "scene.gbuffer_along", "scene.load", "scene.material_ids"),
    *("scene.object_ids", "scene.occlusion", "scene.plan_views", "scene.still_life"),
    *("scene.transfer", "scene.visible"),
    # Searches, plans and measurements in Python, which look at what they have found so far.
    *("budget.accumulate", "budget.dof", "budget.relight", "budget.reproject", "budget.shadow"),
    *("tradeoff.measure", "tradeoff.pareto", "tradeoff.plot", "tradeoff.save"),
    "fit.focal_stack",
    # They are given a function, a renderer or an effect, which they call.
    *("dof.accumulate", "relight.capture_normals", "sharding.rows", "sharding.target_rows"),
    # No image: cameras of a light. No floats: the pixels that `shadow.edge_pcf` filters, by its
    # own code.
    *("shadow.light_cameras", "shadow.candidates"),
}


def test_every_public_function_is_in_a_list():
    """A new effect is tested as a batch by itself, or fails here until it is named."""
    public = set()
    for module in pkgutil.iter_modules(jaxfx.__path__):
        if module.name.startswith("_"):
            continue
        face = importlib.import_module(f"jaxfx.{module.name}")
        for name in getattr(face, "__all__", ()):
            function = getattr(face, name)
            if callable(function) and not inspect.isclass(function):
                public.add(f"{module.name}.{name}")
    fits = {f"fit.{name.partition(',')[0]}" for name in FITS}
    assert public == {*FUNCTIONS, *fits, *NO_BATCH}
    tested = {case.function for case in CASES.values()}
    assert tested == set(FUNCTIONS.values())


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_function_carries_on_any_mesh(name):
    """Without it a call under explicit axes works in one release of JAX, not in another."""
    assert "@on_any_mesh" in inspect.getsource(inspect.unwrap(FUNCTIONS[name]))


def assert_divided(answer):
    """Equal to a single device, of which no other asks anything, and spread as it came."""
    assert answer["error"] < 1e-9
    assert answer["collectives"] == []
    assert answer["is_spread"]


@pytest.mark.parametrize("name", QUICK)
@pytest.mark.parametrize("mesh", MESHES)
def test_a_batch_is_computed_where_it_lies(eight_devices, name, mesh):
    assert_divided(eight_devices("batch", name=name, mesh=mesh, gradient=False))


def meshes_of(name):
    """The meshes on which a case is tested: as many as its code differs on.

    A function with its default options is tested on all of them. An option whose value has a
    program of its own is not tested on automatic axes: on explicit ones a function runs as on
    those. What is computed for an argument that is left out is tested on one mesh, and a case
    that differs by a type of argument alone on none.
    """
    if name in FUNCTIONS:
        return MESHES
    if not CASES[name].is_option:
        return ()
    return ("explicit",) if name.endswith("=None") else ("explicit", "shard_map")


def size_of(name):
    """The height and width of a case's images: a score needs a whole window."""
    return (13, 11) if name.startswith("metrics.") else (9, 7)


def on_meshes(cases):
    """Parametrize by cases, each on its meshes, one after the other: they share a reference."""
    pairs = [(name, mesh) for name in cases for mesh in meshes_of(name)]
    return pytest.mark.parametrize(("name", "mesh"), pairs)


@pytest.mark.full
@on_meshes([name for name in CASES if not name.startswith("dof.")])
def test_every_function_and_its_gradient_are_computed_where_a_batch_lies(
    eight_devices, name, mesh
):
    assert_divided(eight_devices("batch", name=name, mesh=mesh, size=size_of(name)))


@pytest.mark.full
@pytest.mark.parametrize("name", ["dof.scatter", "reproject.warp"])
@pytest.mark.parametrize("mesh", MESHES)
def test_a_batch_lies_along_one_axis_of_two(eight_devices, name, mesh):
    """On the other axis its devices hold the same, and are known to."""
    grid = {"shape": (4, 2), "names": ("batch", "other")}
    assert_divided(eight_devices("batch", name=name, mesh=mesh, **grid))
