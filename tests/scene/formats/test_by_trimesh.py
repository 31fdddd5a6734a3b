"""Meshes of trimesh: what is read, and that their caches change nothing."""

import bz2

import numpy as np
import pytest
import trimesh
from PIL import Image

from jaxfx import io, scene


def box():
    return trimesh.creation.box((2, 2, 2))


def used(mesh):
    """A mesh after all properties that trimesh computes and caches were read."""
    for name in ("vertex_normals", "face_normals", "face_angles", "visual"):
        getattr(mesh, name)
    mesh.visual.vertex_colors, mesh.visual.face_colors  # noqa: B018
    return mesh


@pytest.mark.parametrize("make", [box, trimesh.creation.icosphere, trimesh.creation.torus])
def test_what_was_asked_before_does_not_matter(make):
    if make is trimesh.creation.torus:
        make = lambda: trimesh.creation.torus(2, 1)
    turn = trimesh.transformations.rotation_matrix(0.3, [1, 2, 3], [0.5, 0, 0])
    fresh = make().apply_transform(turn)
    for mesh in (
        used(make()).apply_transform(turn),
        used(fresh.copy()),
        used(make()).copy(include_cache=True).apply_transform(turn),
    ):
        found, expected = scene.from_trimesh(mesh), scene.from_trimesh(fresh)
        np.testing.assert_allclose(found.normals, expected.normals, atol=1e-6)
        np.testing.assert_array_equal(found.colors, expected.colors)
        assert found.materials[0].color == expected.materials[0].color


def test_a_mesh_is_left_as_it_was():
    mesh = box()
    scene.from_trimesh(mesh, smooth=True)
    assert scene.from_trimesh(mesh).normals[0, 0] == pytest.approx([-1, 0, 0])
    assert b"property float nx" not in mesh.export(file_type="ply")


def test_smooth_and_flat_on_demand():
    mesh = trimesh.creation.icosphere(2)
    corners = mesh.vertices[mesh.faces]
    smooth = scene.from_trimesh(mesh, smooth=True)
    np.testing.assert_allclose(smooth.normals, corners, atol=0.02)
    given = -3 * mesh.vertices
    mesh.vertex_normals = given
    found = scene.from_trimesh(mesh)
    np.testing.assert_allclose(found.normals, -corners, atol=1e-6)
    flat = scene.from_trimesh(mesh, smooth=False)
    normal = np.asarray(mesh.face_normals)[:, None]
    np.testing.assert_allclose(flat.normals - normal, 0, atol=1e-6)


@pytest.mark.parametrize("of", ["face_colors", "vertex_colors"])
def test_default_colors_that_were_changed_are_the_meshs_own(of):
    mesh = box()
    getattr(mesh.visual, of)[:] = [255, 0, 0, 255]
    np.testing.assert_array_equal(scene.from_trimesh(mesh).colors - [1, 0, 0], 0)


def test_16_bits_of_a_material():
    code = 30001
    image = Image.fromarray(np.full((2, 2), code, np.uint16))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image)
    visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)
    found = scene.from_trimesh(trimesh.Trimesh(*_arrays(), visual=visual, process=False))
    np.testing.assert_array_equal(found.materials[0].texture, np.uint16(code))
    material.baseColorTexture = Image.fromarray(np.ones((2, 2), np.float32))
    with pytest.raises(ValueError, match=r"`scene\.from_trimesh\(mesh\)` .* 8 nor 16 bits"):
        scene.from_trimesh(trimesh.Trimesh(*_arrays(), visual=visual, process=False))


def _arrays():
    mesh = box()
    return mesh.vertices, mesh.faces


def test_colors_of_16_bits_that_trimesh_cuts(tmp_path):
    lines = ["ply", "format ascii 1.0", "element vertex 3"]
    lines += [f"property float {name}" for name in "xyz"]
    lines += [f"property ushort {name}" for name in ("red", "green", "blue")]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    lines += ["0 0 0 13107 0 65535", "1 0 0 13107 0 65535", "0 1 0 13107 0 65535", "3 0 1 2"]
    (tmp_path / "a.ply").write_text("\n".join(lines))
    mesh = trimesh.load_mesh(tmp_path / "a.ply", process=False)
    with pytest.raises(ValueError, match=r"cut its colours of uint16 to bytes; `scene.load`"):
        scene.from_trimesh(mesh)
    expected = io.linear_from_srgb(np.array([0.2, 0, 1]))
    loaded = scene.load(tmp_path / "a.ply")
    np.testing.assert_allclose(loaded.colors - expected, 0, atol=1e-6)
    mesh.visual.vertex_colors = [255, 255, 255, 255]
    assert (scene.from_trimesh(mesh).colors == 1).all()


def test_stl_is_flat(tmp_path):
    mesh = trimesh.creation.icosphere(1)
    mesh.export(tmp_path / "a.stl")
    loaded = scene.load(tmp_path / "a.stl")
    normal = np.asarray(mesh.face_normals)[:, None]
    np.testing.assert_allclose(loaded.normals - normal, 0, atol=1e-5)
    assert loaded.materials[0].color == (0.8, 0.8, 0.8)


def test_archives_are_refused(tmp_path):
    (tmp_path / "a.obj.bz2").write_bytes(bz2.compress(b"v 0 0 0\n"))
    with pytest.raises(ValueError, match=r"a\.obj\.bz2': it is an archive"):
        scene.load(tmp_path / "a.obj.bz2")
