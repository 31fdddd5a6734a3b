"""Calls every effect in an environment that has jaxfx without extras, and no pytest.

Prints how many functions it called. `tests/test_install.py` runs it.
"""

import inspect
import sys

import jax
import jax.numpy as jnp
import numpy as np

import jaxfx
from jaxfx import (
    GBuffer,
    PinholeCamera,
    PointLight,
    ThinLens,
    Transfer,
    blur,
    dof,
    fit,
    metrics,
    relight,
    reproject,
    scene,
    shadow,
    tradeoff,
)


EXTRAS = {"OpenEXR", "OpenGL", "PIL", "embreex", "matplotlib", "pyrender", "tqdm", "trimesh"}
SIZE = HEIGHT, WIDTH = 9, 11

rng = np.random.default_rng(0)
image = rng.uniform(0.1, 1, (*SIZE, 3)).astype(np.float32)
depth = rng.uniform(2, 3, SIZE).astype(np.float32)
normal = np.broadcast_to(np.float32([0, 0, -1]), (*SIZE, 3))
camera = PinholeCamera.from_fov(0.9, height=HEIGHT, width=WIDTH)
lens = ThinLens.from_camera(camera, aperture=3.0, focus_distance=2.5)
lamp = PointLight([0.2, -1.0, 0.1], [3.0, 3.0, 3.0])
gbuffer = GBuffer(
    image, np.full(SIZE, 1), image, image, image, normal, depth, np.full(SIZE, 0.5, np.float32)
)
transfer = Transfer(
    image[..., :2], image[0, :5, :2].T, image[0, :5], normal[0, :5], image[0, :5]
)
receivers = shadow.receivers(depth, camera, camera)
wide = np.tile(image, (2, 2, 1))
DEPTH_OF_FIELD = (
    *("dof.scatter", "dof.layered", "dof.gather", "dof.blend", "dof.depth_sorted"),
    *("dof.anisotropic_diffusion", "dof.implicit_diffusion", "dof.separable", "dof.peel"),
)


def effects():
    """The arguments and options of a call of every public function of the effects, by name."""
    calls = {name: ((image, depth, lens), {"max_coc": 6}) for name in DEPTH_OF_FIELD}
    calls |= {
        f"shadow.{name}": ((depth, receivers), {"size": 3})
        for name in ("prefiltered", "pcf", "edge_pcf", "candidates", "variance")
    }
    return calls | {
        "dof.accumulate": ((lambda eye: jnp.asarray(image), camera, lens), {"samples": 2}),
        "blur.gaussian": ((image,), {"sigma": 1.0}),
        "blur.downsample": ((image,), {}),
        "blur.binomial_weights": ((5,), {"row": 6}),
        "blur.linear_taps": ((blur.binomial_weights(5, row=6),), {}),
        "reproject.intersect": ((depth, np.zeros((7, 3)), rng.uniform(1, 2, (7, 3))), {}),
        "reproject.warp": ((image, depth, camera, camera), {}),
        "reproject.blend": (([image], [depth], [camera], camera), {}),
        "reproject.choose": (([depth], [camera], camera), {"count": 1}),
        "shadow.hard": ((depth, receivers), {}),
        "shadow.receivers": ((depth, camera, camera), {}),
        "shadow.light_cameras": ((lamp,), {"map_size": 8}),
        "shadow.pcss": ((depth, receivers, camera), {"size": 3, "light_size": 0.1}),
        "metrics.psnr": ((image, image * 0.9), {}),
        "metrics.ssim": ((wide, wide * 0.9), {}),
        "relight.shade": ((gbuffer, camera, lamp), {}),
        "relight.render": ((gbuffer, camera, [lamp]), {}),
        "relight.start": ((gbuffer, camera, [lamp]), {}),
        "relight.synthesize": (([gbuffer], [camera], camera), {"depth": depth}),
        "relight.choose": (([gbuffer], [camera], camera), {"depth": depth, "count": 1}),
        "relight.fill_holes": ((gbuffer, np.ones(SIZE, np.int32)), {}),
        "relight.capture_normals": ((lambda lights: jnp.asarray(image),), {}),
        "relight.indirect": ((gbuffer, transfer, [lamp]), {}),
        "relight.mirrored": ((gbuffer, camera), {}),
        "relight.refracted": ((gbuffer, camera), {}),
        "relight.fresnel": ((gbuffer, camera), {}),
    }


def public():
    """All functions of the effects, by name."""
    for module in (dof, blur, reproject, shadow, relight, metrics):
        for name in module.__all__:
            value = getattr(module, name)
            if callable(value) and not inspect.isclass(value):
                yield f"{module.__name__.removeprefix('jaxfx.')}.{name}", value


def missing(extra, call):
    """Assert that a call raises an error that names the extra which it needs."""
    try:
        call()
    except ImportError as error:
        assert f"jaxfx[{extra}]" in str(error), error
    else:
        raise AssertionError(f"the extra {extra!r} is not missed")


def main():
    calls, count = effects(), 0
    for name, function in public():
        arguments, options = calls[name]
        assert jax.tree.leaves(function(*arguments, **options)), name
        count += 1
    blurred = dof.scatter(image, depth, lens)
    fitted = fit.dof(blurred, image, depth, lens, max_steps=2, throw=False)
    assert fitted.lens.aperture > 0
    assert not EXTRAS & sys.modules.keys()
    missing("scene", lambda: scene.load(__file__))
    missing("io", lambda: jaxfx.exr.write("a.exr", image))
    missing("io", lambda: jaxfx.io.write_png("a.png", image))
    missing("plot", lambda: tradeoff.save(None, "a.png"))
    missing("plot", lambda: fit.dof(blurred, image, depth, lens, progress=True))
    print(f"{count} functions")


if __name__ == "__main__":
    main()
