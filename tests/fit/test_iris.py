"""`fit.dof` with an iris: rotation and squeeze of what drew an image, and what is refused."""

import inspect
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import PinholeCamera, ThinLens, dof, fit
from jaxfx._sampling import pixel_centers
from jaxfx.dof import Iris


FOCUS, WALL = 2.0, 4.0
TRUTH = Iris(6, rotation=0.25, squeeze=0.7)
START = Iris(6, rotation=0.1, squeeze=0.9)
NAMES = ["aperture", "rotation", "squeeze"]


class Night:
    """A dark wall with lights, each a Gaussian of about two pixels."""

    def __init__(self, size, aperture):
        self.shape = size, size
        self.camera = PinholeCamera.from_fov(0.8, height=size, width=size)
        options = {"aperture": aperture, "focus_distance": FOCUS}
        self.lens = ThinLens.from_camera(self.camera, **options)
        self.depth = np.full(self.shape, WALL)
        self.image = jax.jit(self.view)(self.camera)

    def view(self, camera):
        pixels = pixel_centers(*self.shape, camera.intrinsics.dtype)
        points = camera.unproject(pixels, jnp.full(self.shape, WALL, pixels.dtype))
        centers = jnp.asarray(np.random.default_rng(0).uniform(-1.4, 1.4, (14, 2)))
        away = jnp.sum((points[..., None, :2] - centers[None, None]) ** 2, axis=-1)
        size = 1.2 * WALL / self.camera.intrinsics[0, 0]
        return 0.1 + 5 * jnp.sum(jnp.exp(-away / size**2), axis=-1, keepdims=True)

    def fitted(self, reference, **options):
        lens = self.lens
        start = ThinLens(0.9 * float(lens.aperture), FOCUS, lens.focal_pixels)
        coc = math.ceil(1.3 * float(lens.circle_of_confusion(WALL)))
        options = {"parameters": NAMES, "iris": START, "max_coc": coc} | options
        return fit.dof(reference, self.image, self.depth, start, **options)


def test_finds_the_iris_that_drew_the_image():
    night = Night(40, 0.7)
    options = {"iris": TRUTH, "gamma": 1.0}
    photograph = dof.scatter(night.image, night.depth, night.lens, **options)
    found = night.fitted(photograph)
    assert found.success
    assert found.iris is not None
    assert float(found.iris.squeeze) == pytest.approx(0.7, rel=1e-3)
    assert float(found.iris.rotation) == pytest.approx(0.25, abs=1e-3)
    assert set(found.standard_errors) == set(NAMES)


@pytest.mark.full
def test_finds_the_iris_of_many_pinholes():
    """Rotation to a hundredth of the angle between blades, squeeze and aperture to 1 %.

    At a circle of confusion of 20 pixels. At 8 pixels the rotation is off by a tenth: spans
    end sharply within each row, which such small shapes show.
    """
    night = Night(56, 1.2)
    options = {"samples": 512, "iris": TRUTH}
    photograph = dof.accumulate(jax.jit(night.view), night.camera, night.lens, **options).image
    found = night.fitted(photograph, effect="layered")
    assert found.success
    assert found.iris is not None
    assert float(found.iris.squeeze) == pytest.approx(0.7, rel=0.01)
    assert float(found.iris.rotation) == pytest.approx(0.25, abs=0.01 * math.pi / 3)
    assert float(found.lens.aperture) == pytest.approx(1.2, rel=0.01)


def test_what_has_no_iris_or_no_rotation_is_refused():
    night = Night(8, 0.7)
    image = np.ones((8, 8, 1))
    for iris in (None, Iris(squeeze=0.9)):
        with pytest.raises(ValueError, match=r"dof\(parameters=...\)` must name some of"):
            night.fitted(image, iris=iris)
    with pytest.raises(ValueError, match=r"dof\(iris=...\)` must be an Iris, got float"):
        inspect.unwrap(fit.dof)(image, image, night.depth, night.lens, iris=0.5)
