"""The built-in scene: reproducible, with objects near and far, textures without seams."""

import numpy as np
import pytest

from jaxfx import scene


@pytest.fixture(scope="module")
def room():
    return scene.still_life()


def test_still_life_is_the_same_every_time(room):
    again = scene.still_life()
    np.testing.assert_array_equal(room.vertices, again.vertices)
    np.testing.assert_array_equal(room.uv, again.uv)
    for one, other in zip(room.materials, again.materials, strict=True):
        np.testing.assert_array_equal(one.texture, other.texture)


@pytest.mark.parametrize(("height", "width"), [(320, 320), (120, 213), (180, 240)])
def test_still_life_reaches_from_near_to_far(room, height, width):
    size = {"height": height, "width": width}
    camera = scene.default_camera(room, **size)
    buffer = scene.gbuffer(room, camera, **size)
    depth = np.asarray(buffer.depth)
    assert np.isfinite(depth).all()
    assert depth.max() > 8 * depth.min()
    ids = np.asarray(scene.object_ids(room, camera, **size))
    seen = {room.names[i] for i in np.unique(ids)}
    assert {"near ball", "near rod 0", "marble", "far ball", "far rod 3", "wall"} <= seen
    # Objects before, at and behind a focus of 2.8 each cover a good part of the image.
    for low, high in [(0, 1.5), (2.2, 3.5), (5, 9)]:
        assert np.mean((depth > low) & (depth < high)) > 0.05
    # Saturated colours, and fine detail that still averages out.
    color = np.asarray(buffer.color)
    assert np.mean(np.ptp(color, axis=-1) > 0.3) > 0.3
    assert set(np.unique(buffer.shader)) == {0, 2}


@pytest.mark.parametrize("name", ["near ball", "marble", "far ball", "near post"])
def test_still_life_has_no_seams(room, name):
    """Faces that share a vertex have the same texel there; no face spans the texture."""
    mine = room.face_objects == room.names.index(name)
    corners, uv = room.vertices[room.faces[mine]], room.uv[mine].astype(float)
    middle = (corners.min((0, 1)) + corners.max((0, 1))) / 2
    off_axis = np.linalg.norm((corners - middle)[..., [0, 2]], axis=-1)
    side = np.abs(room.normals[mine][..., 1]) < 0.9
    away = (off_axis > 0.4 * off_axis.max()).all(axis=1) & side.all(axis=1)
    assert away.sum() > 50
    turn = np.ptp(uv[away][..., 0], axis=1)
    assert turn.max() < 1.2
    vertices = room.faces[mine][away].ravel()
    phase = np.exp(2j * np.pi * uv[away].reshape(-1, 2))
    order = np.argsort(vertices, kind="stable")
    same = np.diff(vertices[order]) == 0
    assert same.sum() > 50
    assert np.abs(np.diff(phase[order], axis=0))[same].max() < 1e-4
