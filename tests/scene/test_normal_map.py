"""Normal maps against tangent frames written by hand; the material that a pixel shows."""

import numpy as np
import trimesh
from PIL import Image

from jaxfx import scene


# Tilted along u, along v, along both, not at all (128 is the nearest byte to 0.5).
MAP = np.array(
    [
        [[230, 128, 200], [128, 230, 200], [60, 90, 220]],
        [[20, 128, 200], [128, 20, 200], [128, 128, 255]],
    ],
    np.uint8,
)
CORNERS = np.array([[0, 0, 0], [3, 0, 0], [3, 2, 0], [0, 2, 0]], float)
UV = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)


def unit(vector):
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


def quad(uv=UV, transform=None, normal_map=MAP):
    """A mapped quad over [0, 3] x [0, 2], its front towards +z."""
    material = trimesh.visual.material.PBRMaterial(
        normalTexture=Image.fromarray(normal_map), metallicFactor=0
    )
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    mesh = trimesh.Trimesh(CORNERS, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)
    content = trimesh.Scene()
    content.add_geometry(mesh, transform=transform)
    return content


def normals(content, camera, backend="embree"):
    mesh = scene.from_trimesh(content)
    return np.asarray(scene.gbuffer(mesh, camera, height=2, width=3, backend=backend).normal)


BENT = unit(MAP / 127.5 - 1)


def test_u_is_right_v_is_up_and_blue_is_out(straight, backend):
    np.testing.assert_allclose(normals(quad(), straight(2), backend), BENT, atol=1e-6)


def test_a_glb_file_keeps_its_map(tmp_path, straight):
    quad().export(tmp_path / "quad.glb")
    loaded = scene.load(tmp_path / "quad.glb")
    found = scene.gbuffer(loaded, straight(2), height=2, width=3, backend="embree").normal
    np.testing.assert_allclose(found, BENT, atol=1e-6)


def test_mirrored_texture_coordinates_mirror_the_bend(straight):
    mirrored = np.stack([1 - UV[:, 0], UV[:, 1]], axis=1)
    expected = BENT[:, ::-1] * [-1, 1, 1]
    np.testing.assert_allclose(normals(quad(mirrored), straight(2)), expected, atol=1e-6)


def test_tangents_turn_with_the_texture(straight):
    """Texture coordinates rotated by 90 degrees: u points up, v to the left."""
    turned = np.stack([UV[:, 1], 1 - UV[:, 0]], axis=1)
    flat = np.full((2, 3, 3), MAP[0, 0])
    bent = unit(MAP[0, 0] / 127.5 - 1)
    expected = np.array([-bent[1], bent[0], bent[2]])
    found = normals(quad(turned, normal_map=flat), straight(2))
    np.testing.assert_allclose(found - expected, 0, atol=1e-6)


def test_the_back_shows_the_same_bumps_from_behind(straight):
    """Rotated by 180 degrees about y: bumps on the front are dents seen from the back."""
    half = np.diag([-1.0, 1.0, -1.0, 1.0])
    half[0, 3] = 3
    expected = -(BENT[:, ::-1] * [-1, 1, -1])
    np.testing.assert_allclose(normals(quad(transform=half), straight(2)), expected, atol=1e-6)


def test_texture_coordinates_without_area_do_not_bend(straight):
    found = normals(quad(np.zeros((4, 2))), straight(2))
    np.testing.assert_allclose(found - [0, 0, 1], 0, atol=1e-6)


def test_which_material_a_pixel_shows(straight, backend):
    kinds = trimesh.visual.material
    visual = trimesh.visual.TextureVisuals(
        uv=UV,
        material=kinds.MultiMaterial([kinds.PBRMaterial(), kinds.PBRMaterial()]),
        face_materials=[1, 0],
    )
    mesh = trimesh.Trimesh(CORNERS, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)
    ids = scene.material_ids(
        scene.from_trimesh(mesh), straight(2), height=2, width=5, backend=backend
    )
    assert ids.dtype == np.int32
    np.testing.assert_array_equal(ids[:, 3:], -1)
    assert (int(ids[1, 2]), int(ids[0, 0])) == (1, 0)
