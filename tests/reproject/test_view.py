"""Where the pixels of a target lie in a camera, against `project` of the true points."""

import jax.numpy as jnp
import numpy as np

from benchmarks.scenes.reproject import camera
from jaxfx._sampling import pixel_centers
from jaxfx.reproject.view import trace_with_angle


def test_a_plane_is_seen_where_its_points_project_to():
    """The plane z = 4 of one camera, from another that stands beside it and nearer."""
    depth, eye = np.full((24, 32), 4.0), camera()
    target = camera(at=(0.2, 0.1, 0.5))
    pixels = pixel_centers(24, 32).reshape(-1, 2)
    options = {"search": "pyramid", "hole_threshold": 0.1}
    view, cosine, target_depth = trace_with_angle(
        jnp.asarray(depth), eye, target, pixels, **options
    )
    points = target.unproject(pixels, jnp.full(24 * 32, 3.5))
    expected, _ = eye.project(points)
    shown = np.asarray(view.mask)
    assert shown.sum() > 400
    np.testing.assert_allclose(view.pixels[shown], expected[shown], atol=1e-9)
    np.testing.assert_allclose(view.reciprocal_depth[shown], 1 / 4, atol=1e-12)
    np.testing.assert_allclose(target_depth[shown], 3.5, atol=1e-9)
    eyes = [np.asarray(e.world_from_camera)[:3, 3] for e in (eye, target)]
    rays = [np.asarray(points) - position for position in eyes]
    rays = [r / np.linalg.norm(r, axis=-1, keepdims=True) for r in rays]
    np.testing.assert_allclose(cosine[shown], (rays[0] * rays[1]).sum(-1)[shown], atol=1e-12)
