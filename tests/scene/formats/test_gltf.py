"""glTF: features of the standard, against its formulas written out."""

import json
import logging
import struct

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from jaxfx import scene


CORNERS = np.array([[0, 0, 0], [3, 0, 0], [3, 2, 0], [0, 2, 0]], float)


def triangles(mesh):
    """The corners' positions, face 3 3."""
    return mesh.vertices[mesh.faces]


@pytest.mark.parametrize(("dtype", "top"), [("u1", 255), ("u2", 65535)])
@pytest.mark.parametrize("gap", [0, 4])
def test_normalized_texture_coordinates(gltf, uv, texels, codes, dtype, top, gap):
    where = gltf.accessor(uv * top, dtype, normalized=True, gap=gap)
    path = gltf.save(gltf.quad(TEXCOORD_0=where, material=gltf.material("texels.png")))
    np.testing.assert_array_equal(codes(scene.load(path)), texels)


@pytest.mark.parametrize(("dtype", "top"), [("i1", 127), ("i2", 32767), ("u2", 65535)])
def test_quantized_positions(gltf, dtype, top):
    small = np.rint(CORNERS / 3 * top)
    position = gltf.accessor(small, dtype, normalized=True, gap=2)
    path = gltf.save(
        gltf.quad(POSITION=position),
        nodes=[{"mesh": 0, "scale": [3, 3, 3]}],
        extensionsRequired=["KHR_mesh_quantization"],
    )
    np.testing.assert_allclose(
        triangles(scene.load(path)), 3 * (small / top)[[[0, 1, 2], [0, 2, 3]]], rtol=1e-12
    )
    lowest = gltf.accessor([[-128] * 3, [127, 0, 0], [0, 127, 0]], "i1", normalized=True)
    loaded = scene.load(gltf.save(gltf.quad(POSITION=lowest, faces=None)))
    np.testing.assert_allclose(loaded.vertices[0], -1)


def test_integer_positions_that_are_not_normalized(gltf):
    position = gltf.accessor(10 * CORNERS, "i2", gap=2)
    loaded = scene.load(gltf.save(gltf.quad(POSITION=position)))
    np.testing.assert_array_equal(loaded.bounds, [[0, 0, 0], [30, 20, 0]])


@pytest.mark.parametrize("based", [True, False])
def test_sparse_accessors(gltf, based):
    values = gltf.view(np.array([[3, 2, 5], [0, 2, 7]], "<f4").tobytes())
    at = gltf.view(np.array([2, 3], "<u2").tobytes())
    sparse = {
        "count": 2,
        "indices": {"bufferView": at, "componentType": 5123},
        "values": {"bufferView": values},
    }
    if based:
        position = gltf.accessor(CORNERS, sparse=sparse)
    else:
        position = gltf.record(4, 3, sparse=sparse)
    expected = (CORNERS if based else 0 * CORNERS).copy()
    expected[2:] = [[3, 2, 5], [0, 2, 7]]
    loaded = scene.load(gltf.save(gltf.quad(POSITION=position)))
    np.testing.assert_array_equal(loaded.vertices, expected)


@pytest.mark.parametrize(
    ("mode", "faces", "expected"),
    [
        (4, [0, 1, 2, 0, 2, 3], [[0, 1, 2], [0, 2, 3]]),
        (4, None, [[0, 1, 2]]),
        (5, [1, 2, 0, 3], [[1, 2, 0], [2, 3, 0]]),
        (6, [0, 1, 2, 3], [[1, 2, 0], [2, 3, 0]]),
    ],
)
def test_lists_strips_and_fans(gltf, mode, faces, expected):
    position = gltf.accessor(CORNERS[: 3 if faces is None else 4])
    loaded = scene.load(gltf.save(gltf.quad(POSITION=position, mode=mode, faces=faces)))
    np.testing.assert_array_equal(triangles(loaded), CORNERS[expected])
    # All of these are counter-clockwise seen from +z.
    np.testing.assert_allclose(loaded.normals[..., 2], 1)


def test_points_and_lines_are_left_out_and_said_so(gltf, caplog):
    path = gltf.save(gltf.quad(), gltf.quad(mode=0), gltf.quad(mode=3))
    with caplog.at_level(logging.WARNING, "jaxfx"):
        assert len(scene.load(path).faces) == 2
    assert [record.getMessage() for record in caplog.records] == [
        f"scene.load({str(path)!r}): left out are points and lines"
    ]


def rotation(axis, angle):
    """A rotation as matrix and quaternion, by SciPy."""
    turn = Rotation.from_rotvec(angle * np.array(axis) / np.linalg.norm(axis))
    return turn.as_matrix(), turn.as_quat().tolist()


def test_nodes_below_nodes(gltf):
    turn, quaternion = rotation([1, 2, 3], 0.7)
    inner = np.array([[1.0, 0.5, 0, 3], [0, 2, 0, 1], [0, 0, -1, 2], [0, 0, 0, 1]])
    nodes = [
        {"mesh": 0, "matrix": inner.T.ravel().tolist(), "name": "leaf"},
        {"children": [0], "scale": [1, 2, 3], "rotation": quaternion, "camera": 0},
        {"children": [1], "translation": [5, 6, 7]},
    ]
    camera = {"type": "orthographic", "orthographic": {}}
    path = gltf.save(gltf.quad(), nodes=nodes, scenes=[{"nodes": [2]}], cameras=[camera])
    loaded = scene.load(path)
    expected = CORNERS @ inner[:3, :3].T + inner[:3, 3]
    expected = expected * [1, 2, 3] @ turn.T + [5, 6, 7]
    np.testing.assert_allclose(loaded.vertices, expected, rtol=1e-12, atol=1e-12)
    assert loaded.names == ("leaf",)
    # The determinant is negative: the order of the corners is reversed.
    np.testing.assert_allclose(triangles(loaded)[0], expected[[0, 2, 1]], atol=1e-12)


def test_only_the_files_scene_is_drawn_and_names_are_told_apart(gltf):
    nodes = [{"mesh": 0, "name": "a"}, {"mesh": 0, "name": "a"}, {"mesh": 0, "name": "other"}]
    quad = gltf.quad()
    scenes = [{"nodes": [2]}, {"nodes": [1, 0]}]
    assert scene.load(gltf.save(quad, nodes=nodes, scenes=scenes, scene=1)).names == (
        "a",
        "a_1",
    )
    assert scene.load(gltf.save(quad, nodes=nodes, scenes=scenes)).names == ("other",)


def test_two_primitives_of_a_node_are_one_object_of_two_materials(gltf):
    gltf.json["materials"] = [{"pbrMetallicRoughness": {"metallicFactor": 0}}, {}]
    loaded = scene.load(gltf.save(gltf.quad(material=1), gltf.quad(material=0)))
    assert loaded.names == ("node 0",)
    metallic = [loaded.materials[i].metallic for i in loaded.face_materials]
    assert metallic == [1, 1, 0, 0]


def test_instances(gltf):
    turn, quaternion = rotation([0, 0, 1], np.pi / 2)
    attributes = {
        "TRANSLATION": gltf.accessor([[0, 0, 0], [5, 0, 0]]),
        "ROTATION": gltf.accessor([[0, 0, 0, 1], quaternion]),
        "SCALE": gltf.accessor([[1, 1, 1], [2, 1, 1]]),
    }
    extension = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
    node = {"mesh": 0, "translation": [0, 0, 9], "extensions": extension, "name": "tree"}
    required = ["EXT_mesh_gpu_instancing"]
    loaded = scene.load(gltf.save(gltf.quad(), nodes=[node], extensionsRequired=required))
    second = CORNERS * [2, 1, 1] @ turn.T + [5, 0, 9]
    np.testing.assert_allclose(
        loaded.vertices, [*(CORNERS + np.array([0, 0, 9])), *second], atol=1e-6
    )
    assert loaded.names == ("tree", "tree_1")
    assert len(loaded.materials) == 1


def test_a_skin_is_where_its_joints_are_whatever_its_own_node_says(gltf):
    """The standard's sum over joints, vertex by vertex; the mesh's node does not count."""
    turn, quaternion = rotation([0, 1, 0], 0.4)
    binds = np.stack([np.eye(4), np.eye(4)])
    binds[1, :3, 3] = -3, 0, 0
    weights = np.array([[1, 0], [0.25, 0.75], [0, 1], [0.5, 0.5]])
    corners = gltf.accessor(CORNERS)
    attributes = {
        "POSITION": corners,
        "NORMAL": gltf.accessor([[0, 0, 1]] * 4),
        "JOINTS_0": gltf.accessor([[0, 1, 0, 0]] * 4, "u1"),
        "WEIGHTS_0": gltf.accessor(np.pad(weights, ((0, 0), (0, 2)))),
    }
    skin = {"joints": [1, 2], "inverseBindMatrices": gltf.accessor(binds.transpose(0, 2, 1))}
    nodes = [
        {"mesh": 0, "skin": 0, "translation": [100, 100, 100]},
        {"children": [2], "translation": [0, 1, 0]},
        {"translation": [3, 0, 0], "rotation": quaternion},
    ]
    top = {"nodes": nodes, "skins": [skin], "scenes": [{"nodes": [0, 1]}]}
    loaded = scene.load(gltf.save(gltf.quad(**attributes), **top))
    first, second = np.eye(4), np.eye(4)
    first[:3, 3] = 0, 1, 0
    second[:3, :3], second[:3, 3] = turn, [3, 1, 0]
    for i, corner in enumerate(CORNERS):
        joint = weights[i, 0] * first @ binds[0] + weights[i, 1] * second @ binds[1]
        np.testing.assert_allclose(loaded.vertices[i], (joint @ [*corner, 1])[:3], atol=1e-6)
    at_second = (loaded.faces == 2).nonzero()
    np.testing.assert_allclose(loaded.normals[at_second], [turn[:, 2]] * 2, atol=1e-6)


def test_morph_targets_by_their_weights(gltf):
    moved = {"POSITION": gltf.accessor([[0, 0, 2]] * 4)}
    other = {"POSITION": gltf.accessor([[0, 8, 0]] * 4)}
    quad = gltf.quad() | {"targets": [moved, other]}
    mesh = [{"primitives": [quad], "weights": [0.5, 0.25]}]
    loaded = scene.load(gltf.save(meshes=mesh))
    np.testing.assert_allclose(loaded.vertices, CORNERS + np.array([0, 2, 1]))
    node = [{"mesh": 0, "weights": [1, 0]}]
    loaded = scene.load(gltf.save(meshes=mesh, nodes=node))
    np.testing.assert_allclose(loaded.vertices, CORNERS + np.array([0, 0, 2]))


def extended(**transform):
    return {"extensions": {"KHR_texture_transform": transform}}


def test_texture_transform_against_its_matrices(gltf, uv, texels, straight):
    """The product of the extension's three matrices, texel by texel."""
    offset, angle, scale = [0.3, -0.2], 0.5, [0.8, 1.7]
    info = extended(offset=offset, rotation=angle, scale=scale)
    sampler = {"magFilter": 9728}
    where = gltf.accessor(uv)
    material = gltf.material("texels.png", sampler, **info)
    required = {"extensionsRequired": ["KHR_texture_transform"]}
    loaded = scene.load(gltf.save(gltf.quad(TEXCOORD_0=where, material=material), **required))
    shown = scene.gbuffer(loaded, straight(20, 10), height=20, width=30, backend="embree")
    move = np.array([[1, 0, 0], [0, 1, 0], [*offset, 1]]).T
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    size = np.diag([*scale, 1])
    for row, column in np.random.default_rng(0).integers(0, 20, (40, 2)):
        u, v, _ = move @ turn @ size @ [(column + 0.5) / 30, (row + 0.5) / 20, 1]
        texel = texels[int(np.floor(v * 2)) % 2, int(np.floor(u * 3)) % 3] / 255
        expected = np.where(texel <= 0.04045, texel / 12.92, ((texel + 0.055) / 1.055) ** 2.4)
        np.testing.assert_allclose(shown.color[row, column], expected, atol=1e-6)


def test_each_texture_has_its_own_coordinates(gltf, uv, texels, codes):
    """Set 1 for colour; set 3, transformed, for roughness and metallic."""
    mirrored = uv * [-1, 1] + [1, 0]
    places = {"TEXCOORD_1": gltf.accessor(uv), "TEXCOORD_3": gltf.accessor(mirrored)}
    material = gltf.material("texels.png", texCoord=1)
    more = {"index": 0, "texCoord": 0} | extended(texCoord=3, offset=[1 / 3, 0])
    surface = gltf.json["materials"][material]["pbrMetallicRoughness"]
    surface["metallicRoughnessTexture"] = more
    loaded = scene.load(gltf.save(gltf.quad(**places, material=material)))
    np.testing.assert_array_equal(codes(loaded), texels)
    camera = scene.default_camera(loaded, height=8, width=8)
    assert np.isfinite(scene.gbuffer(loaded, camera, height=8, width=8).roughness).all()
    sampler = loaded.materials[0].samplers["metallic_roughness"]
    assert sampler.use_second_uv
    np.testing.assert_allclose(loaded.second_uv[0], (mirrored * [1, -1] + [0, 1])[[0, 1, 2]])


WRAPS = {10497: [0, 1, 2], 33071: [2, 2, 2], 33648: [2, 1, 0]}


@pytest.mark.parametrize("along_u", WRAPS)
@pytest.mark.parametrize("along_v", WRAPS)
def test_wraps(gltf, uv, texels, codes, along_u, along_v):
    """Coordinates from 1 to 2."""
    where = gltf.accessor(uv + 1)
    sampler = {"wrapS": along_u, "wrapT": along_v}
    material = gltf.material("texels.png", sampler)
    loaded = scene.load(gltf.save(gltf.quad(TEXCOORD_0=where, material=material)))
    rows = {10497: [0, 1], 33071: [1, 1], 33648: [1, 0]}[along_v]
    np.testing.assert_array_equal(codes(loaded), texels[rows][:, WRAPS[along_u]])


def test_nearest_texels(gltf, uv, texels, codes):
    material = gltf.material("texels.png", {"magFilter": 9728})
    path = gltf.save(gltf.quad(TEXCOORD_0=gltf.accessor(uv), material=material))
    np.testing.assert_array_equal(
        codes(scene.load(path), scale=4), texels.repeat(4, axis=0).repeat(4, axis=1)
    )


@pytest.mark.parametrize(
    ("file", "uri"),
    [
        ("my t.png", "my%20t.png"),
        ("my t.png", "my t.png"),
        ("ü.png", "%C3%BC.png"),
        ("a%20b.png", "a%20b.png"),
        ("Case.PNG", "case.png"),
        ("sub/t.png", "./sub/t.png"),
        ("sub/t.png", "SUB/T.png"),
        ("sub/t.png", "sub\\t.png"),
    ],
)
def test_names_of_images(gltf, uv, texels, codes, file, uri):
    (gltf.folder / file).parent.mkdir(exist_ok=True)
    (gltf.folder / "texels.png").rename(gltf.folder / file)
    path = gltf.save(gltf.quad(TEXCOORD_0=gltf.accessor(uv), material=gltf.material(uri)))
    np.testing.assert_array_equal(codes(scene.load(path)), texels)


def test_webp_images(gltf, uv, texels, codes):
    Image.fromarray(texels).save(gltf.folder / "t.webp", lossless=True)
    material = gltf.material("t.webp")
    gltf.json["textures"] = [{"extensions": {"EXT_texture_webp": {"source": 0}}}]
    quad = gltf.quad(TEXCOORD_0=gltf.accessor(uv), material=material)
    path = gltf.save(quad, extensionsRequired=["EXT_texture_webp"])
    np.testing.assert_array_equal(codes(scene.load(path)), texels)


def test_16_bits_of_a_normal_map_and_its_scale(gltf, uv, straight):
    """A 16-bit code between two 8-bit ones, with a scale of one half."""
    code = 40000
    Image.fromarray(np.full((2, 2), code, np.uint16)).save(gltf.folder / "bump.png")
    material = gltf.material("bump.png")
    gltf.json["materials"][material]["normalTexture"] = {"index": 0, "scale": 0.5}
    quad = gltf.quad(TEXCOORD_0=gltf.accessor(uv), material=material)
    shown = scene.gbuffer(
        scene.load(gltf.save(quad)), straight(2), height=2, width=3, backend="embree"
    )
    bend = 2 * code / 65535 - 1
    expected = np.array([bend / 2, bend / 2, bend])
    np.testing.assert_allclose(
        shown.normal[1, 1], expected / np.linalg.norm(expected), atol=2e-7
    )
    curve = ((code / 65535 + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(shown.color, curve, rtol=1e-6)


@pytest.mark.parametrize(("dtype", "top"), [("u1", 255), ("u2", 65535), ("f4", 1)])
@pytest.mark.parametrize("width", [3, 4])
def test_vertex_colors_by_their_type(gltf, dtype, top, width):
    code = np.rint(np.array([0.2, 0.5, 0.9, 1]) * top) if top > 1 else [0.2, 0.5, 0.9, 1]
    code = np.array(code)[:width]
    colors = gltf.accessor([code] * 4, dtype, normalized=top > 1, gap=-width % 4)
    loaded = scene.load(gltf.save(gltf.quad(COLOR_0=colors)))
    np.testing.assert_allclose(loaded.colors - code[:3] / top, 0, atol=1e-7)


def test_no_material_is_the_standards_default(gltf):
    loaded = scene.load(gltf.save(gltf.quad()))
    (material,) = loaded.materials
    assert (material.color, material.metallic, material.roughness) == ((1, 1, 1), 1, 1)


def test_a_glb_holds_its_image_and_numbers(gltf, uv, texels, codes):
    image = gltf.view((gltf.folder / "texels.png").read_bytes())
    quad = gltf.quad(TEXCOORD_0=gltf.accessor(uv), material=gltf.material("gone.png"))
    gltf.json["images"] = [{"bufferView": image, "mimeType": "image/png"}]
    whole = json.loads(gltf.save(quad).read_text())
    whole["buffers"] = [{"byteLength": len(gltf.binary)}]
    text = json.dumps(whole).encode()
    text += b" " * (-len(text) % 4)
    body = gltf.binary + b"\0" * (-len(gltf.binary) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(body), b"BIN\0") + body
    path = gltf.folder / "a.glb"
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    np.testing.assert_array_equal(codes(scene.load(path)), texels)
    path.write_bytes(path.read_bytes()[:-8])
    with pytest.raises(ValueError, match=r"a\.glb': it is GLB version 2 of"):
        scene.load(path)


def test_what_is_optional_and_left_out_is_said_once(gltf, caplog):
    gltf.json["materials"] = [
        {
            "alphaMode": "BLEND",
            "emissiveFactor": [1, 0, 0],
            "occlusionTexture": {"index": 0},
            "extensions": {"KHR_materials_unlit": {}},
        }
    ]
    path = gltf.save(
        gltf.quad(material=0), gltf.quad(material=0), extensionsUsed=["EXT_any", "KHR_other"]
    )
    with caplog.at_level(logging.WARNING, "jaxfx"):
        scene.load(path)
    (record,) = caplog.records
    assert record.getMessage().endswith(
        "left out are EXT_any, KHR_materials_unlit, KHR_other, alpha, emission, occlusion"
    )


DRACO = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}


@pytest.mark.parametrize("name", ["KHR_draco_mesh_compression", "EXT_whatever"])
def test_a_required_extension_is_named(gltf, name):
    path = gltf.save(gltf.quad(), extensionsRequired=[name])
    with pytest.raises(ValueError, match=rf"a\.gltf': it requires {name}, which is not read"):
        scene.load(path)


def test_packed_numbers_without_their_plain_ones(gltf):
    quad = gltf.quad() | {"extensions": DRACO}
    del gltf.json["accessors"][0]["bufferView"]
    with pytest.raises(ValueError, match="POSITION is held by KHR_draco_mesh_compression"):
        scene.load(gltf.save(quad))


GLOSSY = "KHR_materials_pbrSpecularGlossiness"
BROKEN = {
    "no such accessor": (lambda d: d["accessors"].pop(), "no entry 2 in 'accessors'"),
    "a count too large": (lambda d: d["accessors"][0].update(count=5), "do not lie in"),
    "a negative offset": (lambda d: d["accessors"][0].update(byteOffset=-4), "do not lie in"),
    "a view past its buffer": (
        lambda d: d["bufferViews"][2].update(byteLength=999),
        "bufferView 2 has 999 bytes",
    ),
    "a negative index": (lambda d: d["materials"][0].update(normalTexture={"index": -1}), "-1"),
    "a count of words": (lambda d: d["accessors"][0].update(count="4"), "'count' must be int"),
    "another type": (lambda d: d["accessors"][0].update(type="VEC3"), "is 4 of 'VEC3'"),
    "no such component": (
        lambda d: d["accessors"][0].update(componentType=9),
        "componentType 9",
    ),
    "no such wrap": (lambda d: d["samplers"].append({"wrapS": 7}), "wraps"),
    "a ring of nodes": (
        lambda d: d.update(nodes=[{"children": [1]}, {"children": [0], "mesh": 0}]),
        "has a parent|ancestors",
    ),
    "two parents": (
        lambda d: d.update(nodes=[{"children": [2]}, {"children": [2]}, {"mesh": 0}]),
        "node 2 is listed as a child twice",
    ),
    "no affine matrix": (lambda d: d.update(nodes=[{"mesh": 0, "matrix": [1] * 16}]), "affine"),
    "no unit rotation": (
        lambda d: d.update(nodes=[{"mesh": 0, "rotation": [0, 0, 1, 1]}]),
        "unit quaternion",
    ),
    "a factor of 3": (
        lambda d: d["materials"][0]["pbrMetallicRoughness"].update(metallicFactor=3),
        r"'metallicFactor' must be in \[0, 1\]",
    ),
    "version 1": (lambda d: d.update(asset={"version": "1.0"}), "glTF version 1.0"),
    "no such scene": (lambda d: d.update(scene=3), "no entry 3 in 'scenes'"),
    "no data for a buffer": (
        lambda d: d.update(buffers=[{"byteLength": 9}]),
        "buffer 0 has no",
    ),
    "a buffer on the web": (
        lambda d: d.update(buffers=[{"byteLength": 9, "uri": "https://a.b/c"}]),
        "is not a file beside this one",
    ),
    "no base64": (
        lambda d: d.update(buffers=[{"byteLength": 9, "uri": "data:;base64,????"}]),
        "is not base64",
    ),
    "an image that is none": (lambda d: d["images"][0].update(uri="a.bin"), "neither PNG"),
    "an image that is not there": (lambda d: d["images"][0].update(uri="gone.png"), "gone.png"),
    "an image by an extension": (
        lambda d: d.update(textures=[{"extensions": {"KHR_texture_basisu": {"source": 0}}}]),
        "held by KHR_texture_basisu",
    ),
    "gloss alone": (
        lambda d: d.update(
            materials=[{"extensions": {"KHR_materials_pbrSpecularGlossiness": {}}}]
        ),
        "KHR_materials_pbrSpecularGlossiness alone",
    ),
    "coordinates that are not there": (
        lambda d: d["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"].update(
            texCoord=1
        ),
        "TEXCOORD_1, which its mesh does not have",
    ),
    "a mode that is none": (lambda d: d.update(mode=9), "of mode 9"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_errors_name_the_file_and_the_fault(gltf, uv, texels, name):
    edit, complaint = BROKEN[name]
    where = gltf.accessor(uv)
    quad = gltf.quad(TEXCOORD_0=where, material=gltf.material("texels.png", {"wrapS": 10497}))
    whole = json.loads(gltf.save(quad).read_text())
    edit(whole)
    if "mode" in whole:
        whole["meshes"][0]["primitives"][0]["mode"] = whole.pop("mode")
    if len(whole["samplers"]) > 1:
        whole["textures"][0]["sampler"] = 1
    (gltf.folder / "a.gltf").write_text(json.dumps(whole))
    with pytest.raises(ValueError, match=rf"`scene\.load\(path\)`.*a\.gltf'.*({complaint})"):
        scene.load(gltf.folder / "a.gltf")


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_not_finite(gltf, value):
    corners = CORNERS.copy()
    corners[1, 1] = value
    path = gltf.save(gltf.quad(POSITION=gltf.accessor(corners)))
    with pytest.raises(ValueError, match=r"a\.gltf': accessor 0 holds numbers that are not"):
        scene.load(path)
