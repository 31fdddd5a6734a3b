"""Why caches are not antialiased: shade, then average, and not the other way round."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import DirectionalLight, GBuffer, PinholeCamera, metrics, relight, scene


FINE = 4
FLOATS = ("color", "ambient", "diffuse", "specular", "normal", "depth", "roughness")


def shrunk(image):
    rows, columns = (side // FINE for side in image.shape[:2])
    blocks = np.asarray(image).reshape(rows, FINE, columns, FINE, *image.shape[2:])
    return jnp.asarray(blocks.mean(axis=(1, 3)))


def averaged(gbuffer):
    """One cache of the means of blocks, as an antialiasing renderer would write it."""
    far = jnp.where(jnp.isfinite(gbuffer.depth), gbuffer.depth, 20)
    fields = {name: far if name == "depth" else getattr(gbuffer, name) for name in FLOATS}
    middle = gbuffer.shader[FINE // 2 :: FINE, FINE // 2 :: FINE]
    return GBuffer(shader=middle, **{name: shrunk(value) for name, value in fields.items()})


def test_the_mean_of_two_normals_is_a_third_surface():
    """A roof, one side of it in the light, is half lit; its mean normal makes that 0.71."""
    slope = np.sqrt(0.5)
    left = np.arange(FINE)[None, :, None] < FINE // 2
    normal = np.where(left, [slope, 0, -slope], [-slope, 0, -slope])
    one = np.ones((FINE, FINE, 3))
    roof = GBuffer(
        **dict.fromkeys(("color", "ambient", "diffuse", "specular"), one),
        shader=np.zeros((FINE, FINE), int),
        normal=np.broadcast_to(normal, one.shape),
        depth=one[..., 0],
        roughness=one[..., 0],
    )
    camera = PinholeCamera.from_fov(0.5, height=FINE, width=FINE)
    light = DirectionalLight([-slope, 0, slope], [1.0, 1.0, 1.0])
    after = shrunk(relight.shade(roof, camera, light))
    before = relight.shade(averaged(roof), camera, light)
    np.testing.assert_allclose(after, 0.5, rtol=1e-12)
    np.testing.assert_allclose(before, slope, rtol=1e-12)


@pytest.mark.full
def test_averaging_first_is_wrong_along_silhouettes():
    height, width = 24, 32
    size, fine = ({"height": n * height, "width": n * width} for n in (1, FINE))
    mesh = scene.still_life()
    fine_camera, camera = (scene.default_camera(mesh, **each) for each in (fine, size))
    cache = scene.gbuffer(mesh, fine_camera, **fine)
    lights = scene.default_lights(camera)
    truth = shrunk(relight.render(cache, fine_camera, lights))
    wrong = relight.render(averaged(cache), camera, lights)
    ids = scene.object_ids(mesh, fine_camera, **fine)
    blocks = np.asarray(ids).reshape(height, FINE, width, FINE)
    edge = blocks.max(axis=(1, 3)) != blocks.min(axis=(1, 3))
    assert 0.1 < edge.mean() < 0.6
    at_edges, elsewhere = (float(metrics.psnr(wrong, truth, mask=m)) for m in (edge, ~edge))
    assert at_edges < 35
    assert elsewhere > at_edges + 6
