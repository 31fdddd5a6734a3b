"""PLY files as parts of a scene.

Source: Turk 1994, the PLY polygon file format; names of properties as MeshLab writes them.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, Num

from jaxfx.io import linear_from_srgb
from jaxfx.scene._material import Material
from jaxfx.scene._part import UNASSIGNED, Part, UnreadableError, unit
from jaxfx.scene.formats._images import find_file, read_image
from jaxfx.scene.formats._polygons import triangulate


_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4"},
    **{"uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_COORDINATES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
_COLORS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"))


@dataclass
class _Element:
    """What the head says of an element: its properties' types, and of lists their counts'."""

    count: int
    types: dict[str, str] = field(default_factory=dict)
    counts: dict[str, str] = field(default_factory=dict)


class _Rows:
    """An element's columns: one number a row, or, of lists, their lengths and all numbers."""

    def __init__(self):
        self.columns: dict[str, np.ndarray] = {}
        self.lists: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def stacked(self, names: tuple[str, ...]) -> Float[np.ndarray, "row column"] | None:
        """The columns of these names side by side, where all are there."""
        if not all(name in self.columns for name in names):
            return None
        return np.stack([self.columns[name] for name in names], axis=1).astype(np.float64)


class _Text:
    """Numbers as text, one after the other."""

    def __init__(self, data: bytes):
        words = data.split()
        self.numbers = np.array(words, np.bytes_).astype(np.float64) if words else np.zeros(0)
        self.at = 0

    def take(self, kind: str, count: int) -> np.ndarray:
        found = self.numbers[self.at : self.at + count]
        self.at += count
        return self._typed(found, kind, count)

    def block(self, kinds: list[str], count: int) -> list[np.ndarray]:
        found = self.take("f8", count * len(kinds)).reshape(count, len(kinds))
        return [self._typed(found[:, i], kind, count) for i, kind in enumerate(kinds)]

    def _typed(self, found: np.ndarray, kind: str, count: int) -> np.ndarray:
        if len(found) < count:
            raise UnreadableError("it ends early")
        with np.errstate(invalid="ignore"):
            typed = found.astype(kind)
        if kind[0] != "f" and not np.array_equal(typed, found):
            raise UnreadableError(f"a number is no {np.dtype(kind)}")
        return typed

    def require_end(self) -> None:
        if self.at < len(self.numbers):
            raise UnreadableError(f"{len(self.numbers) - self.at} numbers are left over")


class _Binary:
    """Numbers of known types, byte after byte."""

    def __init__(self, data: bytes, order: str):
        self.data, self.order, self.at = data, order, 0

    def take(self, kind: str, count: int) -> np.ndarray:
        return self._read(np.dtype(self.order + kind), count)

    def block(self, kinds: list[str], count: int) -> list[np.ndarray]:
        row = np.dtype([(f"{i}", self.order + kind) for i, kind in enumerate(kinds)])
        found = self._read(row, count)
        return [found[name] for name in row.names or ()]

    def _read(self, dtype: np.dtype, count: int) -> np.ndarray:
        if count < 0 or self.at + count * dtype.itemsize > len(self.data):
            raise UnreadableError("it ends early")
        found = np.frombuffer(self.data, dtype, count, self.at)
        self.at += found.nbytes
        return found

    def require_end(self) -> None:
        if self.data[self.at :].strip():
            raise UnreadableError(f"{len(self.data) - self.at} bytes are left over")


def read(path: Path, data: bytes) -> tuple[list[Part], set[str]]:
    """The one part of a PLY file, and what of the file it leaves out."""
    order, elements, textures, start = _head(data)
    source = _Text(data[start:]) if order == "" else _Binary(data[start:], order)
    tables = {name: _table(source, each) for name, each in elements.items() if each.types}
    source.require_end()
    ignored = {f"element {name!r}" for name in set(elements) - {"vertex", "face"}}
    if "tristrips" in elements:
        raise UnreadableError("it holds tristrips, which are not read")
    if "vertex" not in tables or "face" not in tables:
        return [], ignored
    files = [find_file(path.parent, name) for name in textures]
    images = [read_image(file.read_bytes(), str(file)) for file in files]
    return [_part(path.name, tables["vertex"], tables["face"], images, ignored)], ignored


def _head(data: bytes) -> tuple[str, dict[str, _Element], list[str], int]:
    """Byte order ("" for text), elements, textures, and where the data begin."""
    end = data.find(b"end_header")
    start = data.find(b"\n", end) + 1
    if not data.startswith(b"ply") or end < 0 or start == 0:
        raise UnreadableError("it has no head of a PLY file")
    order, elements, textures = None, {}, []
    element = _Element(0)
    for line in data[:end].decode("utf-8", "surrogateescape").splitlines()[1:]:
        words = line.split()
        match words:
            case ["format", kind, "1.0"] if kind in _ORDERS:
                order = _ORDERS[kind]
            case ["comment", keyword, *_] if keyword.lower() == "texturefile":
                textures.append(line.split(None, 2)[2].strip())
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["element", name, count] if name not in elements:
                element = elements[name] = _Element(int(count))
            case ["property", "list", length, kind, name] if name not in element.types:
                element.types[name], element.counts[name] = _TYPES[kind], _TYPES[length]
            case ["property", kind, name] if name not in element.types:
                element.types[name] = _TYPES[kind]
            case _:
                raise UnreadableError(f"its head says {line!r:.60}")
    if order is None or any(each.count < 0 for each in elements.values()):
        raise UnreadableError("its head names no format, or fewer than 0 rows")
    return order, elements, textures, start


def _table(source: _Text | _Binary, element: _Element) -> _Rows:
    """An element's rows; at once where all lists are as long as in the first row."""
    rows, start = _Rows(), source.at
    if not element.count:
        return rows
    first = {name: len(values) for name, values in _row(source, element)}
    source.at = start
    kinds = []
    for name, kind in element.types.items():
        kinds += [element.counts[name]] if name in element.counts else []
        kinds += [kind] * first[name]
    try:
        columns = iter(source.block(kinds, element.count))
    except UnreadableError:  # lists of several lengths, or a fault that the other will name
        source.at = start
        return _uneven_table(source, element)
    found = {}
    for name in element.types:
        counted = next(columns) if name in element.counts else None
        if counted is not None and (counted != first[name]).any():
            source.at = start
            return _uneven_table(source, element)
        values = [next(columns) for _ in range(first[name])]
        if counted is None:
            rows.columns[name] = values[0]
        else:
            flat = np.stack(values, axis=1).ravel() if values else np.zeros(0, np.intp)
            found[name] = (np.full(element.count, first[name]), flat)
    rows.lists = found
    return rows


def _uneven_table(source: _Text | _Binary, element: _Element) -> _Rows:
    found: dict[str, list[np.ndarray]] = {name: [] for name in element.types}
    for _ in range(element.count):
        for name, values in _row(source, element):
            found[name].append(values)
    rows = _Rows()
    for name, values in found.items():
        if name in element.counts:
            rows.lists[name] = (np.array([len(v) for v in values]), np.concatenate(values))
        else:
            rows.columns[name] = np.concatenate(values)
    return rows


def _row(source: _Text | _Binary, element: _Element) -> Iterator[tuple[str, np.ndarray]]:
    for name, kind in element.types.items():
        count = 1
        if name in element.counts:
            count = int(source.take(element.counts[name], 1)[0])
            if count < 0:
                raise UnreadableError(f"a list of {count} {name}")
        yield name, source.take(kind, count)


def _part(
    name: str, vertex: _Rows, face: _Rows, images: list[np.ndarray], ignored: set[str]
) -> Part:
    vertices = vertex.stacked(("x", "y", "z"))
    named = [key for key in ("vertex_indices", "vertex_index") if key in face.lists]
    if vertices is None or not named:
        raise UnreadableError("it has no x, y, z of vertices, or no vertex_indices of faces")
    sizes, corners = face.lists[named[0]]
    if len(corners) and not 0 <= corners.min() <= corners.max() < len(vertices):
        raise UnreadableError(
            f"faces have vertices {corners.min()} to {corners.max()} of {len(vertices)}"
        )
    if (sizes < 3).any():
        raise UnreadableError(f"a face has {sizes.min()} corners")
    at, owner, crossing = triangulate(vertices[corners], sizes)
    if crossing:
        ignored.add(f"how {crossing} polygons that cross themselves are to be cut")
    faces = corners[at].astype(np.intp)
    colors, uv = _colors(vertex), _uv(vertex, face, sizes)
    if colors is not None:
        colors = colors[faces]
    elif (of_face := _colors(face)) is not None:
        colors = np.repeat(of_face[owner][:, None], 3, axis=1)
    normals = vertex.stacked(("nx", "ny", "nz"))
    if uv is not None:
        uv = uv[at] if len(uv) == len(corners) and "texcoord" in face.lists else uv[faces]
    plain = UNASSIGNED if colors is None else Material()
    materials, chosen = [plain], np.zeros(len(faces), np.intp)
    if images and uv is None:
        raise UnreadableError("it names a texture, and has no texture coordinates")
    if images:
        materials = [Material(texture=image) for image in images]
        if "texnumber" in face.columns:
            chosen = face.columns["texnumber"][owner].astype(np.intp)
        if len(chosen) and not 0 <= chosen.min() <= chosen.max() < len(images):
            raise UnreadableError(f"a face has texnumber {chosen.max()} of {len(images)}")
    return Part(
        vertices,
        faces,
        materials,
        chosen,
        [name],
        np.zeros(len(faces), np.intp),
        None if normals is None else unit(normals)[faces],
        uv,
        None,
        colors,
    )


def _colors(rows: _Rows) -> Float[np.ndarray, "row 3"] | None:
    """Linear RGB of colours by type: unsigned ones over their largest, floats as they are."""
    for names in _COLORS:
        if not all(name in rows.columns for name in names):
            continue
        values = np.stack([_shares(name, rows.columns[name]) for name in names], axis=1)
        return linear_from_srgb(values)
    return None


def _shares(name: str, codes: Num[np.ndarray, " row"]) -> Float[np.ndarray, " row"]:
    if codes.dtype.kind == "i":
        raise UnreadableError(f"{name} is of type {codes.dtype}, whose white is unknown")
    shares = codes / (np.iinfo(codes.dtype).max if codes.dtype.kind == "u" else 1)
    if not ((shares >= 0) & (shares <= 1)).all():
        raise UnreadableError(f"{name} of type {codes.dtype} is not in [0, 1]")
    return shares.astype(np.float64)


def _uv(
    vertex: _Rows, face: _Rows, sizes: Int[np.ndarray, " face"]
) -> Float[np.ndarray, "place 2"] | None:
    """Texture coordinates: of every corner of the faces, else of every vertex."""
    if "texcoord" in face.lists:
        lengths, flat = face.lists["texcoord"]
        if not np.array_equal(lengths, 2 * sizes):
            raise UnreadableError("texcoord must hold two numbers for each corner of a face")
        return flat.reshape(-1, 2).astype(np.float64)
    found = [vertex.stacked(names) for names in _COORDINATES]
    return next((uv for uv in found if uv is not None), None)
