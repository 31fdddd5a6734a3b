"""Why caches are not antialiased: shade, then average, and not the other way round."""

import numpy as np
from relight_failures import FINE, averaged, shrunk

from jaxfx import DirectionalLight, GBuffer, PinholeCamera, relight


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
