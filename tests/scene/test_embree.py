"""Embree: no ray passes between adjacent faces."""

import numpy as np
import trimesh

from jaxfx import scene
from jaxfx.scene import embree


def test_no_ray_slips_between_faces(camera, backend, rays):
    """A mesh whose vertices lie on the pixels' rays, up to rounding."""
    height, width = 60, 83
    near, direction = rays(camera, height, width)
    depth = np.random.default_rng(0).uniform(4, 8, (height, width))
    vertices = near + depth[..., None] * direction
    index = np.arange(height * width).reshape(height, width)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    sheet = trimesh.Trimesh(vertices.reshape(-1, 3), faces, process=False)
    found = scene.depth(
        scene.from_trimesh(sheet), camera, height=height, width=width, backend=backend
    )
    assert np.isfinite(found[1:-1, 1:-1]).all()


def test_rays_at_edges():
    """Nearly all rays from a ball's centre through the middles of its edges meet a face.

    A scene that is not robust loses one in ten.
    """
    ball = trimesh.creation.icosphere(5)
    ball.apply_transform(trimesh.transformations.euler_matrix(0.3, 0.4, 0.5))
    middles = ball.vertices[ball.edges_unique].mean(axis=1)
    built = embree.accelerated(scene.from_trimesh(ball))
    faces = built.run(np.zeros(middles.shape, np.float32), middles.astype(np.float32))
    assert np.mean(faces >= 0) > 0.98
