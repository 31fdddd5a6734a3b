"""Damaged glTF, OBJ and PLY files: an error, or an independent reader's mesh."""

import base64
import itertools
import json

import numpy as np
import pytest

from jaxfx import scene


COUNT = 300


def normalized(triangles):
    """Triangles in canonical order: each from its smallest corner, then all sorted."""
    turned = []
    for triangle in np.round(np.asarray(triangles, float), 4).tolist():
        first = min(range(3), key=lambda i: triangle[i:] + triangle[:i])
        turned.append(triangle[first:] + triangle[:first])
    return sorted(turned)


def check(path, read):
    """1 for an error that names the file, 0 for the right mesh."""
    try:
        loaded = scene.load(path)
    except ValueError as error:
        assert path.name in str(error)
        return 1
    found = normalized(loaded.vertices[loaded.faces])
    expected = normalized(read(path))
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3)
    return 0


# An independent reader of glTF, recursive and index by index, for what these files use.

FORMATS = {5121: "<u1", 5123: "<u2", 5125: "<u4", 5126: "<f4", 5120: "<i1", 5122: "<i2"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def gltf_rows(doc, index):
    accessor = doc["accessors"][index]
    dtype, width = np.dtype(FORMATS[accessor["componentType"]]), WIDTHS[accessor["type"]]

    def bytes_of(view_index):
        view = doc["bufferViews"][view_index]
        uri = doc["buffers"][view["buffer"]]["uri"]
        data = base64.b64decode(uri.split(",")[1])
        return data[view.get("byteOffset", 0) :], view.get("byteStride")

    rows = np.zeros((int(accessor["count"]), width))
    if "bufferView" in accessor:
        data, stride = bytes_of(accessor["bufferView"])
        for i in range(len(rows)):
            at = accessor.get("byteOffset", 0) + i * (stride or dtype.itemsize * width)
            with np.errstate(invalid="ignore"):  # rows that others replace
                rows[i] = np.frombuffer(data, dtype, width, int(at))
    if "sparse" in accessor:
        sparse = accessor["sparse"]
        where, _ = bytes_of(sparse["indices"]["bufferView"])
        what, _ = bytes_of(sparse["values"]["bufferView"])
        index_type = FORMATS[sparse["indices"]["componentType"]]
        at = np.frombuffer(
            where, index_type, sparse["count"], sparse["indices"].get("byteOffset", 0)
        )
        new = np.frombuffer(
            what, dtype, sparse["count"] * width, sparse["values"].get("byteOffset", 0)
        )
        for i, row in enumerate(at):
            rows[row] = new[i * width : (i + 1) * width]
    if accessor.get("normalized", False) and dtype.kind in "iu":
        rows = np.maximum(rows / np.iinfo(dtype).max, -1)
    return rows


def whole_or_float(text):
    value = float(text)
    return int(value) if value.is_integer() else value


def gltf_triangles(path):
    doc = json.loads(path.read_text(), parse_float=whole_or_float)
    found = []

    def local(node):
        if "matrix" in node:
            return np.reshape(node["matrix"], (4, 4)).T.astype(float)
        x, y, z, w = node.get("rotation", [0, 0, 0, 1])
        length = np.sqrt(x * x + y * y + z * z + w * w)
        x, y, z, w = x / length, y / length, z / length, w / length
        turn = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        pose = np.eye(4)
        pose[:3, :3] = turn @ np.diag(np.array(node.get("scale", [1, 1, 1]), float))
        pose[:3, 3] = node.get("translation", [0, 0, 0])
        return pose

    def visit(index, above):
        node = doc["nodes"][index]
        pose = above @ local(node)
        if "mesh" in node:
            for primitive in doc["meshes"][node["mesh"]]["primitives"]:
                points = gltf_rows(doc, primitive["attributes"]["POSITION"])
                corners = list(range(len(points)))
                if "indices" in primitive:
                    corners = gltf_rows(doc, primitive["indices"])[:, 0].astype(int).tolist()
                mode = primitive.get("mode", 4)
                threes = {
                    4: zip(corners[::3], corners[1::3], corners[2::3], strict=False),
                    5: [
                        three if i % 2 == 0 else (three[0], three[2], three[1])
                        for i, three in enumerate(
                            zip(corners, corners[1:], corners[2:], strict=False)
                        )
                    ],
                    6: [(a, b, corners[0]) for a, b in itertools.pairwise(corners[1:])],
                }.get(mode, [])
                for three in threes:
                    triangle = [(pose @ [*points[i], 1])[:3].tolist() for i in three]
                    mirrored = np.linalg.det(pose[:3, :3]) < 0
                    found.append(
                        [triangle[0], *reversed(triangle[1:])] if mirrored else triangle
                    )
        for child in node.get("children", []):
            visit(child, pose)

    for root in doc["scenes"][doc.get("scene", 0)]["nodes"]:
        visit(root, np.eye(4))
    return found


def gltf_document():
    """Two meshes at rotated nodes: a list of quantized, sparse rows, a strip and a fan."""
    random = np.random.default_rng(5)
    doc = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0, 3]}]}
    binary, views, accessors = b"", [], []

    def view(data, **more):
        nonlocal binary
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(data)} | more)
        binary += data + b"\0" * (-len(data) % 4)
        return len(views) - 1

    points = random.normal(size=(6, 3)).astype("<f4")
    padded = np.pad(points, ((0, 0), (0, 1)))
    corners = np.array([0, 1, 2, 3, 4, 5, 1, 3, 5], "<u2")
    small = random.integers(-32767, 32768, (5, 4)).astype("<i2")
    for data, kind, shape, more in (
        (view(padded.tobytes(), byteStride=16), 5126, "VEC3", {"count": 6, "byteOffset": 0}),
        (view(small.tobytes(), byteStride=8), 5122, "VEC3", {"count": 5, "normalized": True}),
        (view(corners.tobytes()), 5123, "SCALAR", {"count": 9}),
    ):
        accessors.append({"bufferView": data, "componentType": kind, "type": shape} | more)
    accessors[0]["sparse"] = {
        "count": 2,
        "indices": {"bufferView": view(b"\1\4"), "componentType": 5121},
        "values": {"bufferView": view(np.float32([[1, 2, 3], [4, 5, 6]]).tobytes())},
    }
    doc |= {"accessors": accessors, "bufferViews": views}
    doc["meshes"] = [
        {"primitives": [{"attributes": {"POSITION": 0}, "indices": 2}]},
        {"primitives": [{"attributes": {"POSITION": 1}, "mode": mode} for mode in (5, 6)]},
    ]
    doc["nodes"] = [
        {"children": [1, 2], "rotation": [0, 0.6, 0, 0.8], "translation": [1, 2, 3]},
        {"mesh": 0, "scale": [1, -2, 3]},
        {"mesh": 1},
        {"mesh": 0, "matrix": [1, 0, 0, 0, 0, 0, 1, 0, 0, 1, 0, 0, 7, 8, 9, 1]},
    ]
    code = base64.b64encode(binary).decode()
    uri = f"data:application/octet-stream;base64,{code}"
    doc["buffers"] = [{"byteLength": len(binary), "uri": uri}]
    return doc


def leaves(value, path=()):
    """The path of every value in a JSON document."""
    inner = value.items() if isinstance(value, dict) else ()
    inner = enumerate(value) if isinstance(value, list) else inner
    for key, below in inner:
        yield (*path, key)
        yield from leaves(below, (*path, key))


def damaged_value(random, value):
    others = [-1, 0, 1, 2, 3, 4, 5, 6, 7, 99, 1.5, 1e9, "1", None, True, [], {}, "VEC2"]
    others += [5120, 5121, 5123, 5125]
    if isinstance(value, int | float) and not isinstance(value, bool) and random.random() < 0.5:
        return value + random.choice([-1, 1, 2, 0.25])
    return others[random.integers(len(others))]


def test_damaged_gltf(tmp_path):
    random = np.random.default_rng(0)
    path = tmp_path / "damaged.gltf"
    path.write_text(json.dumps(gltf_document()))
    assert check(path, gltf_triangles) == 0
    text, raised = path.read_text(), 0
    places = list(leaves(gltf_document()))
    for i in range(COUNT):
        if i % 3:
            doc = gltf_document()
            *outer, key = places[random.integers(len(places))]
            where = doc
            for step in outer:
                where = where[step]
            if i % 3 == 1:
                where[key] = damaged_value(random, where[key])
                where[key] = getattr(where[key], "tolist", lambda v=where[key]: v)()
            else:
                del where[key]
            path.write_text(json.dumps(doc))
        else:
            at = random.integers(len(text))
            damaged = chr(random.integers(32, 127))
            path.write_text(text[:at] + damaged + text[at + random.integers(0, 3) :])
        raised += check(path, gltf_triangles)
    assert COUNT / 3 < raised < COUNT


# An independent reader of OBJ, for convex polygons.


def obj_triangles(path):
    points, found = [], []
    for line in path.read_text().replace("\\\n", " ").splitlines():
        word, *rest = line.split("#")[0].split() or [""]
        if word == "v":
            points.append([float(each) for each in rest[:3]])
        if word in ("f", "fo"):
            index = [int(each.split("/")[0]) for each in rest]
            found.append([i - 1 if i > 0 else len(points) + i for i in index])
    return [
        [points[face[0]], points[face[i]], points[face[i + 1]]]
        for face in found
        for i in range(1, len(face) - 1)
    ]


OBJ = """# a pyramid and more
mtllib a.mtl
o one
v 0 0 0
v 2.5 0 0
v 2.5 1.5 0
v 0 1.5 0
v 1.25 0.75 -2e0
vt 0 0
vt 1 0
vt 0.5 1
vn 0 0 1
usemtl red
s 1
f 1/1/1 2/2/1 3/3/1
f 1//1 3//1 4//1
g side
f -5 -1 -4
v 9 9 9
f 2/1 5/2 3/3
usemtl green
s off
f 3 5 6
"""


def test_damaged_obj(tmp_path):
    random = np.random.default_rng(0)
    path = tmp_path / "damaged.obj"
    (tmp_path / "a.mtl").write_text("newmtl red\nKd 1 0 0\nnewmtl green\nKd 0 1 0\n")
    path.write_text(OBJ)
    assert check(path, obj_triangles) == 0
    raised = 0
    for i in range(COUNT):
        at = random.integers(len(OBJ))
        if i % 4 == 0:
            damaged = OBJ[:at]
        elif i % 4 == 1:
            lines = OBJ.splitlines()
            del lines[random.integers(len(lines))]
            damaged = "\n".join(lines)
        else:
            letters = "0123456789-/. vfe\n" if i % 4 == 2 else "".join(map(chr, range(32, 127)))
            letter = letters[random.integers(len(letters))]
            damaged = OBJ[:at] + letter + OBJ[at + random.integers(0, 2) :]
        path.write_text(damaged)
        raised += check(path, obj_triangles)
    assert COUNT / 5 < raised < COUNT


# An independent reader of text PLY, word by word.


def ply_triangles(path):
    header, _, body = path.read_text().partition("end_header\n")
    elements, tables = [], {}
    for line in header.splitlines():
        word, *rest = line.split() or [""]
        if word == "element":
            elements.append((rest[0], int(rest[1]), []))
        if word == "property":
            elements[-1][2].append((rest[-1], rest[0] == "list"))
    words = iter(body.split())
    for name, count, properties in elements:
        tables[name] = [
            {
                key: [float(next(words)) for _ in range(int(next(words)))]
                if is_list
                else float(next(words))
                for key, is_list in properties
            }
            for _ in range(count)
        ]
    points = [[row["x"], row["y"], row["z"]] for row in tables["vertex"]]
    faces = [row.get("vertex_indices", row.get("vertex_index")) for row in tables["face"]]
    return [
        [points[int(face[0])], points[int(face[i])], points[int(face[i + 1])]]
        for face in faces
        for i in range(1, len(face) - 1)
    ]


PLY = """ply
format ascii 1.0
comment a pyramid
element vertex 5
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
element note 2
property list uchar short words
element face 3
property uchar flag
property list uchar int vertex_indices
end_header
0 0 0 255 0 0
2.5 0 0 0 255 0
2.5 1.5 0 0 0 255
0 1.5 0 9 9 9
1.25 0.75 -2e0 8 8 8
3 1 2 3
0
7 4 0 1 2 3
0 3 0 4 1
1 3 1 4 2
"""


def test_damaged_ply(tmp_path):
    random = np.random.default_rng(0)
    path = tmp_path / "damaged.ply"
    path.write_text(PLY)
    assert check(path, ply_triangles) == 0
    raised = 0
    for i in range(COUNT):
        at = random.integers(len(PLY))
        if i % 4 == 0:
            damaged = PLY[:at]
        elif i % 4 == 1:
            lines = PLY.splitlines(keepends=True)
            del lines[random.integers(len(lines))]
            damaged = "".join(lines)
        else:
            letters = "0123456789-. vf\n" if i % 4 == 2 else "".join(map(chr, range(32, 127)))
            letter = letters[random.integers(len(letters))]
            damaged = PLY[:at] + letter + PLY[at + random.integers(0, 2) :]
        path.write_text(damaged)
        raised += check(path, ply_triangles)
    assert COUNT / 5 < raised < COUNT


@pytest.mark.parametrize("suffix", ["glb", "ply", "off", "stl"])
def test_noise_is_refused(tmp_path, suffix):
    random = np.random.default_rng(0)
    starts = {
        "glb": b"glTF\2\0\0\0",
        "ply": b"ply\nformat ascii 1.0\n",
        "off": b"OFF\n",
        "stl": b"",
    }
    path = tmp_path / f"noise.{suffix}"
    for _ in range(20):
        path.write_bytes(starts[suffix] + random.bytes(random.integers(60)))
        with pytest.raises(ValueError, match=f"noise.{suffix}"):
            scene.load(path)
