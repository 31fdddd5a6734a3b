import inspect

import numpy as np
import pytest
import trimesh
from PIL import Image

from jaxfx import scene


def linear(value):
    value = np.asarray(value, float) / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


TEXELS = np.array(
    [
        [[255, 0, 0], [0, 255, 0], [0, 0, 255]],
        [[200, 100, 50], [10, 128, 240], [77, 33, 11]],
    ],
    np.uint8,
)


def textured_quad(folder, *, material="", repeat=1):
    """A quad over [0, 3] x [0, 2] with an upright texture of 3 x 2 texels."""
    Image.fromarray(TEXELS).save(folder / "texels.png")
    (folder / "quad.mtl").write_text(f"newmtl paint\nmap_Kd texels.png\n{material}\n")
    (folder / "quad.obj").write_text(
        "mtllib quad.mtl\nv 0 0 0\nv 3 0 0\nv 3 2 0\nv 0 2 0\n"
        f"vt 0 0\nvt {repeat} 0\nvt {repeat} {repeat}\nvt 0 {repeat}\n"
        "usemtl paint\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
    )
    return folder / "quad.obj"


def test_obj_texels_right_way_up_in_linear_light(tmp_path, straight, backend):
    quad = scene.load(textured_quad(tmp_path, material="Kd 1 1 1"))
    buffer = scene.gbuffer(quad, straight(2), height=2, width=3, backend=backend)
    np.testing.assert_allclose(buffer.color, linear(TEXELS), atol=1e-6)
    np.testing.assert_array_equal(buffer.ambient, buffer.color)
    np.testing.assert_array_equal(buffer.diffuse, buffer.color)
    np.testing.assert_allclose(buffer.specular, 0.04, atol=1e-8)
    np.testing.assert_array_equal(buffer.shader, 0)
    np.testing.assert_array_equal(buffer.roughness, 1)
    np.testing.assert_allclose(buffer.depth, 3, rtol=1e-6)
    np.testing.assert_allclose(buffer.normal, np.broadcast_to([0, 0, 1], (2, 3, 3)))


def test_textures_are_bilinear_and_repeat(tmp_path, straight):
    quad = scene.load(textured_quad(tmp_path))
    buffer = scene.gbuffer(quad, straight(4, 2), height=4, width=6, backend="embree")
    texels = linear(TEXELS)

    def texel(x, y):
        """The texture lookup by its definition, one pixel at a time."""
        column, row = int(np.floor(x - 0.5)), int(np.floor(y - 0.5))
        s, t = x - 0.5 - column, y - 0.5 - row
        at = lambda j, i: texels[j % 2, i % 3]
        above = (1 - s) * at(row, column) + s * at(row, column + 1)
        below = (1 - s) * at(row + 1, column) + s * at(row + 1, column + 1)
        return (1 - t) * above + t * below

    expected = [[texel((i + 0.5) / 2, (j + 0.5) / 2) for i in range(6)] for j in range(4)]
    np.testing.assert_allclose(buffer.color, expected, atol=1e-6)
    # The texture repeated three times along each axis, from the same camera.
    tiled = scene.load(textured_quad(tmp_path, repeat=3))
    buffer = scene.gbuffer(tiled, straight(6, 3), height=6, width=9, backend="embree")
    np.testing.assert_allclose(buffer.color, np.tile(texels, (3, 3, 1)), atol=1e-5)


@pytest.mark.parametrize(
    ("material", "tint", "roughness"),
    [
        ("", [1, 1, 1], 1.0),
        ("Kd 0.5 0.25 1\nKs 0 0 0\nNs 30", linear([127.5, 63.75, 255]), 1.0),
        ("Kd 1 1 1\nKs 1 1 1\nNs 30", [1, 1, 1], 0.25),
        ("Kd 1 1 1\nKs 1 1 1\nNs 0", [1, 1, 1], 1.0),
    ],
)
def test_mtl_factors_and_exponent(tmp_path, straight, material, tint, roughness):
    quad = scene.load(textured_quad(tmp_path, material=material))
    buffer = scene.gbuffer(quad, straight(2), height=2, width=3, backend="embree")
    np.testing.assert_allclose(buffer.color, linear(TEXELS) * tint, atol=1e-6)
    np.testing.assert_allclose(buffer.roughness, roughness, rtol=1e-6)
    np.testing.assert_array_equal(buffer.shader, 0 if roughness == 1 else 2)


def test_ply_vertex_colors_in_linear_light(tmp_path, straight, backend):
    colors = np.array([[255, 0, 20], [30, 200, 128], [5, 90, 250]])
    corners = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0]])
    rows = "\n".join(
        " ".join(map(str, [*corner, *color]))
        for corner, color in zip(corners, colors, strict=True)
    )
    properties = [f"property float {axis}" for axis in "xyz"]
    properties += [f"property uchar {color}" for color in ("red", "green", "blue")]
    (tmp_path / "one.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\n"
        + "\n".join(properties)
        + "\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
        + f"{rows}\n3 0 1 2\n"
    )
    triangle = scene.load(tmp_path / "one.ply")
    buffer = scene.gbuffer(triangle, straight(4), height=4, width=4, backend=backend)
    # Pixel (row 3, column 0) looks at (0.5, 0.5): weights 3/4, 1/8, 1/8; and so on.
    for row, column, weights in [(3, 0, [6, 1, 1]), (3, 2, [2, 5, 1]), (1, 0, [2, 1, 5])]:
        expected = np.array(weights) / 8 @ linear(colors)
        np.testing.assert_allclose(buffer.color[row, column], expected, atol=1e-6)
    assert np.isinf(buffer.depth[0, 3])
    assert (np.asarray(buffer.color) >= 0).all()


def glb_quad(folder, *, transform=None, **factors):
    material = trimesh.visual.material.PBRMaterial(**factors)
    uv = [[0, 0], [1, 0], [1, 1], [0, 1]]
    quad = trimesh.Trimesh(
        [[0, 0, 0], [3, 0, 0], [3, 2, 0], [0, 2, 0]],
        [[0, 1, 2], [0, 2, 3]],
        visual=trimesh.visual.TextureVisuals(uv=uv, material=material),
        process=False,
    )
    content = trimesh.Scene()
    content.add_geometry(quad, node_name="picture", transform=transform)
    content.export(folder / "quad.glb")
    return folder / "quad.glb"


def test_glb_factors(tmp_path, straight, backend):
    path = glb_quad(
        tmp_path,
        baseColorTexture=Image.fromarray(TEXELS),
        baseColorFactor=[51, 102, 255, 255],
        metallicFactor=0.25,
        roughnessFactor=0.5,
    )
    buffer = scene.gbuffer(scene.load(path), straight(2), height=2, width=3, backend=backend)
    # glTF: the texture is sRGB, the factor (0.2, 0.4, 1) is linear.
    base = linear(TEXELS) * [0.2, 0.4, 1]
    np.testing.assert_allclose(buffer.color, base, atol=1e-6)
    np.testing.assert_allclose(buffer.ambient, base, atol=1e-6)
    np.testing.assert_allclose(buffer.diffuse, base * 0.75, atol=1e-6)
    np.testing.assert_allclose(buffer.specular, 0.04 * 0.75 + base * 0.25, atol=1e-6)
    np.testing.assert_allclose(buffer.roughness, 0.5)
    np.testing.assert_array_equal(buffer.shader, 3)


@pytest.mark.parametrize("metallic", [{"metallicFactor": 1.0}, {}])
def test_glb_metal_however_rough_is_no_lambertian(tmp_path, straight, metallic):
    """A metal reflects specularly only; glTF's default is metal."""
    path = glb_quad(
        tmp_path, baseColorFactor=[51, 102, 255, 255], roughnessFactor=1.0, **metallic
    )
    buffer = scene.gbuffer(scene.load(path), straight(2), height=2, width=3, backend="embree")
    np.testing.assert_array_equal(buffer.shader, 3)
    np.testing.assert_array_equal(buffer.diffuse, 0)
    np.testing.assert_allclose(buffer.specular[0, 0], [0.2, 0.4, 1], atol=1e-6)


def test_glb_metallic_roughness_texture(tmp_path, straight):
    path = glb_quad(tmp_path, metallicRoughnessTexture=Image.fromarray(TEXELS))
    buffer = scene.gbuffer(scene.load(path), straight(2), height=2, width=3, backend="embree")
    np.testing.assert_allclose(buffer.roughness, TEXELS[..., 1] / 255, atol=1e-6)
    metallic = TEXELS[..., 2:] / 255
    np.testing.assert_allclose(buffer.diffuse, np.repeat(1 - metallic, 3, -1), atol=1e-6)


def test_glb_vertex_colors_are_linear(tmp_path, straight):
    quad = trimesh.Trimesh(
        [[0, 0, 0], [3, 0, 0], [3, 2, 0], [0, 2, 0]],
        [[0, 1, 2], [0, 2, 3]],
        vertex_colors=np.tile([51, 102, 255, 255], (4, 1)),
        process=False,
    )
    quad.export(tmp_path / "quad.glb")
    loaded = scene.load(tmp_path / "quad.glb")
    buffer = scene.gbuffer(loaded, straight(2), height=2, width=3, backend="embree")
    np.testing.assert_allclose(buffer.color[0, 0], [0.2, 0.4, 1], atol=1e-6)


@pytest.mark.parametrize("mirror", [1, -1])
def test_node_transforms(tmp_path, straight, mirror):
    transform = np.diag([mirror, 1.0, 1.0, 1.0])
    transform[:3, 3] = 3 * (mirror < 0), 0, -2
    path = glb_quad(
        tmp_path,
        transform=transform,
        baseColorTexture=Image.fromarray(TEXELS),
        metallicFactor=0,
    )
    quad = scene.load(path)
    assert quad.names == ("picture",)
    np.testing.assert_allclose(quad.bounds, [[0, 0, -2], [3, 2, -2]])
    buffer = scene.gbuffer(quad, straight(2), height=2, width=3, backend="embree")
    np.testing.assert_allclose(buffer.color, linear(TEXELS)[:, ::mirror], atol=1e-6)
    np.testing.assert_allclose(buffer.depth, 5, rtol=1e-6)
    # The front stays the front: behind a screen it is the second layer.
    screen = trimesh.creation.box((10, 10, 0.1))
    content = trimesh.load_scene(path)
    content.add_geometry(
        screen, transform=trimesh.transformations.translation_matrix([0, 0, 1])
    )
    hidden = scene.depth(
        scene.from_trimesh(content),
        straight(2),
        height=2,
        width=3,
        backend="embree",
        layer_index=1,
    )
    np.testing.assert_allclose(hidden, 5, rtol=1e-6)


def test_normals_turn_with_the_node():
    ball = trimesh.creation.icosphere(3)
    ball.vertex_normals = ball.vertices
    squash = np.diag([1.0, 1.0, 0.25, 1.0])
    content = trimesh.Scene()
    content.add_geometry(ball, transform=squash)
    squashed = scene.from_trimesh(content)
    corners = squashed.vertices[squashed.faces]
    gradient = corners / np.diag(squash)[:3] ** 2  # of x^2 + y^2 + (4 z)^2
    gradient /= np.linalg.norm(gradient, axis=-1, keepdims=True)
    np.testing.assert_allclose(squashed.normals, gradient, atol=1e-6)


def test_files_normals_are_smooth_and_others_flat(straight):
    ball = trimesh.creation.icosphere(1, radius=2)
    ball.apply_translation([2, 2, 0])
    flat = scene.gbuffer(
        scene.from_trimesh(ball), straight(40, 10), height=40, width=40, backend="embree"
    )
    normals = np.asarray(flat.normal)[np.isfinite(flat.depth)]
    assert len(np.unique(np.round(normals, 5), axis=0)) < 60
    ball.vertex_normals = ball.vertices - [2, 2, 0]
    smooth = scene.gbuffer(
        scene.from_trimesh(ball), straight(40, 10), height=40, width=40, backend="embree"
    )
    normals = np.asarray(smooth.normal)[np.isfinite(smooth.depth)]
    assert len(np.unique(np.round(normals, 5), axis=0)) > 900


def test_face_colors_and_plain_meshes(straight):
    box = trimesh.creation.box((4, 4, 4))
    box.apply_translation([2, 2, 0])
    plain = scene.gbuffer(
        scene.from_trimesh(box), straight(4), height=4, width=4, backend="embree"
    )
    np.testing.assert_allclose(plain.color, 0.8, atol=1e-6)
    box.visual.face_colors = np.tile([10, 200, 90, 255], (12, 1))
    coloured = scene.gbuffer(
        scene.from_trimesh(box), straight(4), height=4, width=4, backend="embree"
    )
    np.testing.assert_allclose(coloured.color[2, 1], linear([10, 200, 90]), atol=1e-6)


def test_one_mesh_of_two_materials(straight):
    quad = [[0, 0, 0], [3, 0, 0], [3, 2, 0], [0, 2, 0]]
    kinds = trimesh.visual.material
    paint = [
        kinds.PBRMaterial(baseColorFactor=[51, 51, 51], metallicFactor=0),
        kinds.PBRMaterial(
            baseColorFactor=[255, 102, 51], metallicFactor=0, roughnessFactor=0.5
        ),
    ]
    visual = trimesh.visual.TextureVisuals(
        uv=np.zeros((4, 2)), material=kinds.MultiMaterial(paint), face_materials=[0, 1]
    )
    mesh = trimesh.Trimesh(quad, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)
    buffer = scene.gbuffer(
        scene.from_trimesh(mesh), straight(2), height=2, width=3, backend="embree"
    )
    np.testing.assert_allclose(buffer.color[1, 2], [0.2, 0.2, 0.2], atol=1e-6)
    np.testing.assert_allclose(buffer.color[0, 0], [1, 0.4, 0.2], atol=1e-6)
    assert (buffer.shader[1, 2], buffer.shader[0, 0]) == (3, 3)


def test_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"scene\.load\(path\).*nowhere\.obj"):
        scene.load(tmp_path / "nowhere.obj")


@pytest.mark.parametrize("name", ["junk.glb", "junk.ply", "junk.xyzzy"])
def test_unreadable_file(tmp_path, name):
    (tmp_path / name).write_bytes(b"\x00\x01 not a mesh")
    with pytest.raises(ValueError, match=r"scene\.load\(path\).*mesh that can be read"):
        scene.load(tmp_path / name)


def test_broken_picture(tmp_path):
    path = textured_quad(tmp_path)
    picture = tmp_path / "texels.png"
    picture.write_bytes(picture.read_bytes()[:50])
    with pytest.raises(ValueError, match=r"scene\.load\(path\).*mesh that can be read"):
        scene.load(path)


def test_no_triangles(tmp_path):
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "points.ply")
    with pytest.raises(ValueError, match="at least one triangle, got none"):
        scene.load(tmp_path / "points.ply")
    with pytest.raises(ValueError, match="at least one triangle, got none"):
        scene.from_trimesh(trimesh.Scene())


@pytest.mark.parametrize("value", ["nan", "inf"])
def test_vertices_that_are_not_finite(tmp_path, value):
    (tmp_path / "bad.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 0 {value} 0\nf 1 2 3\n")
    complaint = rf"bad\.obj.* must hold finite vertices, got \[.*{value}.*\] at vertex 2 of"
    with pytest.raises(ValueError, match=complaint):
        scene.load(tmp_path / "bad.obj")


def test_from_trimesh_wants_a_mesh():
    with pytest.raises(ValueError, match=r"scene\.from_trimesh\(mesh\).*got str"):
        inspect.unwrap(scene.from_trimesh)("bunny.obj")
