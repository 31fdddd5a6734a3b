"""PLY: colour types, polygons, byte orders and texture coordinates."""

import numpy as np
import pytest

from jaxfx import io, scene


TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"float": "f4", "double": "f8"},
}
CORNERS = np.array([[0, 0, 0], [3, 0, 0], [3, 2, 0], [0, 2, 0]], float)


def write(path, order, vertex, faces, *, more=(), face_more=(), count="uchar", index="int"):
    """A PLY file: `vertex` a list of (type, name, column), `faces` lists of indices.

    `face_more` holds (declaration, types, rows) of more properties of faces.
    """
    head = ["ply", f"format {order} 1.0", *more, f"element vertex {len(vertex[0][2])}"]
    head += [f"property {kind} {name}" for kind, name, _ in vertex]
    head += [f"element face {len(faces)}", f"property list {count} {index} vertex_indices"]
    head += [each[0] for each in face_more] + ["end_header", ""]
    rows = [[(kind, row) for (kind, _, _), row in zip(vertex, values, strict=True)]
            for values in zip(*(column for _, _, column in vertex), strict=True)]  # fmt: skip
    for i, face in enumerate(faces):
        row = [(count, len(face)), *((index, corner) for corner in face)]
        for _, types, values in face_more:
            row += list(zip(types, values[i], strict=True))
        rows.append(row)
    if order == "ascii":
        body = "\n".join(" ".join(repr(v) for _, v in row) for row in rows).encode()
    else:
        sign = "<" if "little" in order else ">"
        body = b"".join(
            np.array(v, sign + TYPES[kind]).tobytes() for row in rows for kind, v in row
        )
    path.write_bytes("\n".join(head).encode() + body)
    return path


def positions(corners=CORNERS, kind="float"):
    return [(kind, name, corners[:, i].tolist()) for i, name in enumerate("xyz")]


ORDERS = ["ascii", "binary_little_endian", "binary_big_endian"]


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(
    "faces", [[[0, 1, 2, 3]], [[0, 1, 2], [0, 2, 3]], [[0, 1, 2, 3], [0, 1, 2]]]
)
@pytest.mark.parametrize("kind", ["float", "double", "int"])
def test_faces_in_every_order_of_bytes(tmp_path, order, faces, kind):
    vertex = positions(CORNERS.astype(int) if kind == "int" else CORNERS, kind)
    loaded = scene.load(write(tmp_path / "a.ply", order, vertex, faces))
    expected = [[f[0], f[i], f[i + 1]] for f in faces for i in range(1, len(f) - 1)]
    np.testing.assert_array_equal(loaded.vertices[loaded.faces], CORNERS[expected])
    assert loaded.names == ("a.ply",)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(
    ("kind", "top"),
    [("uchar", 255), ("ushort", 65535), ("uint", 2**32 - 1), ("float", None), ("double", None)],
)
@pytest.mark.parametrize(
    "names", [("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue")]
)
def test_colors_by_their_type(tmp_path, order, kind, top, names):
    shares = [0.2, 0.5, 0.9]
    codes = [round(share * top) if top else share for share in shares]
    colors = [(kind, name, [code] * 4) for name, code in zip(names, codes, strict=True)]
    loaded = scene.load(write(tmp_path / "a.ply", order, positions() + colors, [[0, 1, 2]]))
    exact = np.array(codes) / (top or 1)
    np.testing.assert_allclose(loaded.colors - io.linear_from_srgb(exact), 0, atol=1e-6)


def test_colors_of_faces(tmp_path):
    rows = [[65535, 0, 0], [0, 0, 13107]]
    names = ["red", "green", "blue"]
    more = [(f"property ushort {name}", ["ushort"], [[row[i]] for row in rows])
            for i, name in enumerate(names)]  # fmt: skip
    path = write(
        tmp_path / "a.ply",
        "binary_little_endian",
        positions(),
        [[0, 1, 2, 3], [0, 2, 3]],
        face_more=more,
    )
    loaded = scene.load(path)
    expected = io.linear_from_srgb(np.array(rows) / 65535)
    np.testing.assert_allclose(loaded.colors[:, 0], expected[[0, 0, 1]], atol=1e-6)


def test_concave_polygons(tmp_path):
    corners = np.array(
        [[2, 0, 0], [2, 1, 0], [1, 1, 0], [1, 2, 0], [0, 2, 0], [0, 0, 0]], float
    )
    loaded = scene.load(
        write(tmp_path / "a.ply", "ascii", positions(corners), [[0, 1, 2, 3, 4, 5]])
    )
    a, b, c = loaded.vertices[loaded.faces].transpose(1, 0, 2)
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(3)


def test_normals_are_smooth_where_there_are_any(tmp_path):
    normal = [
        ("float", name, [value] * 4) for name, value in (("nx", 0.0), ("ny", 3.0), ("nz", 4.0))
    ]
    loaded = scene.load(write(tmp_path / "a.ply", "ascii", positions() + normal, [[0, 1, 2]]))
    np.testing.assert_allclose(loaded.normals - [0, 0.6, 0.8], 0, atol=1e-6)


UP = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)


@pytest.mark.parametrize("names", [("s", "t"), ("u", "v"), ("texture_u", "texture_v"), None])
@pytest.mark.parametrize("order", ORDERS)
def test_textures(tmp_path, texels, codes, names, order):
    vertex, face_more = positions(), []
    if names is None:
        rows = [[8, *UP.ravel().tolist()]]
        face_more = [("property list uchar float texcoord", ["uchar"] + ["float"] * 8, rows)]
    else:
        vertex += [("float", name, UP[:, i].tolist()) for i, name in enumerate(names)]
    path = write(
        tmp_path / "a.ply",
        order,
        vertex,
        [[0, 1, 2, 3]],
        more=["comment TextureFile texels.png"],
        face_more=face_more,
    )
    np.testing.assert_array_equal(codes(scene.load(path)), texels)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda t: t.replace("3 0 1 2", "3 0 1 4"), "faces have vertices 0 to 4 of 4"),
        (lambda t: t.replace("3 0 1 2", "3 0 1 -1"), "faces have vertices -1"),
        (lambda t: t.replace("3 0 1 2", "2 0 1"), "a face has 2 corners"),
        (lambda t: t.replace("3 0 1 2", "3 0 1 1.5"), "a number is no int32"),
        (lambda t: t + " 7", "numbers are left over"),
        (lambda t: t[:-2], "it ends early"),
        (lambda t: t.replace("format ascii", "format ebcdic"), "header says 'format ebcdic"),
        (lambda t: t.replace("element face", "element tristrips"), "tristrips"),
        (lambda t: t.replace("float z", "float q"), "has no x, y, z"),
        (lambda t: t.replace("comment", "comment TextureFile gone.png"), "no file 'gone.png'"),
        (lambda t: t.replace("float x", "short red\nproperty short green\nproperty short blue\n"
                             "property float x").replace("0.0 0.0 0.0", "1 1 1 0 0 0")
         .replace("3.0 ", "1 1 1 3 ").replace("0.0 2.0 0.0", "1 1 1 0 2 0"),
         "red is of type int16, whose white is unknown"),
    ],
)  # fmt: skip
def test_errors_name_the_file_and_the_fault(tmp_path, change, complaint):
    path = write(tmp_path / "a.ply", "ascii", positions(), [[0, 1, 2]], more=["comment"])
    path.write_text(change(path.read_text()))
    with pytest.raises(ValueError, match=rf"`scene\.load\(path\)`.*a\.ply'.*{complaint}"):
        scene.load(path)
