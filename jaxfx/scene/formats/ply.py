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


# NumPy's types by the names in a header, and the byte orders of formats ("" is text).
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4"},
    **{"uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
# The names that programs give to texture coordinates and colours.
_COORDINATES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
_COLORS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"))


@dataclass
class _Element:
    """An element as the header describes it.

    `count` is the number of rows; `types` the type of each property, `counts` that of a list's
    length.
    """

    count: int
    types: dict[str, str] = field(default_factory=dict)
    counts: dict[str, str] = field(default_factory=dict)


class _Rows:
    """An element's data. `columns` holds one number per row; `lists` the length of each row's
    list, and all lists' numbers one after the other.
    """

    def __init__(self):
        self.columns: dict[str, np.ndarray] = {}
        self.lists: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def stacked(self, names: tuple[str, ...]) -> Float[np.ndarray, "row column"] | None:
        """The columns of these names side by side, as float64; None where one is missing."""
        if not all(name in self.columns for name in names):
            return None
        return np.stack([self.columns[name] for name in names], axis=1).astype(np.float64)


class _Text:
    """A text file's numbers, read in order from index `at`."""

    def __init__(self, data: bytes):
        words = data.split()
        self.numbers = np.array(words, np.bytes_).astype(np.float64) if words else np.zeros(0)
        self.at = 0

    def take(self, kind: str, count: int) -> np.ndarray:
        """The next `count` numbers, of NumPy's type `kind`."""
        numbers = self.numbers[self.at : self.at + count]
        self.at += count
        return self._typed(numbers, kind, count)

    def block(self, kinds: list[str], count: int) -> list[np.ndarray]:
        """The columns of the next `count` rows, which have one number of each of `kinds`."""
        numbers = self.take("f8", count * len(kinds)).reshape(count, len(kinds))
        return [self._typed(numbers[:, i], kind, count) for i, kind in enumerate(kinds)]

    def _typed(self, numbers: np.ndarray, kind: str, count: int) -> np.ndarray:
        """`count` numbers in a type that holds them exactly; `UnreadableError` otherwise."""
        if len(numbers) < count:
            raise UnreadableError("it ends early")
        with np.errstate(invalid="ignore"):
            typed = numbers.astype(kind)
        if kind[0] != "f" and not np.array_equal(typed, numbers):
            raise UnreadableError(f"a number is no {np.dtype(kind)}")
        return typed

    def require_end(self) -> None:
        """Raise `UnreadableError` where numbers are left."""
        if self.at < len(self.numbers):
            raise UnreadableError(f"{len(self.numbers) - self.at} numbers are left over")


class _Binary:
    """A binary file's numbers, read in order from byte `at`."""

    def __init__(self, data: bytes, order: str):
        self.data, self.order, self.at = data, order, 0

    def take(self, kind: str, count: int) -> np.ndarray:
        """As `_Text.take`."""
        return self._read(np.dtype(self.order + kind), count)

    def block(self, kinds: list[str], count: int) -> list[np.ndarray]:
        """As `_Text.block`."""
        row = np.dtype([(f"{i}", self.order + kind) for i, kind in enumerate(kinds)])
        rows = self._read(row, count)
        return [rows[name] for name in row.names or ()]

    def _read(self, dtype: np.dtype, count: int) -> np.ndarray:
        """The next `count` items of a type."""
        if count < 0 or self.at + count * dtype.itemsize > len(self.data):
            raise UnreadableError("it ends early")
        items = np.frombuffer(self.data, dtype, count, self.at)
        self.at += items.nbytes
        return items

    def require_end(self) -> None:
        """Raise `UnreadableError` where bytes other than blanks are left."""
        if self.data[self.at :].strip():
            raise UnreadableError(f"{len(self.data) - self.at} bytes are left over")


def read(path: Path, data: bytes) -> tuple[list[Part], set[str]]:
    """The one part of a PLY file, and the names of what is left out."""
    order, elements, textures, start = _header(data)
    source = _Text(data[start:]) if order == "" else _Binary(data[start:], order)
    tables = {
        name: _table(source, element) for name, element in elements.items() if element.types
    }
    source.require_end()
    ignored = {f"element {name!r}" for name in set(elements) - {"vertex", "face"}}
    if "tristrips" in elements:
        raise UnreadableError("it holds tristrips, which are not read")
    if "vertex" not in tables or "face" not in tables:
        return [], ignored
    files = [find_file(path.parent, name) for name in textures]
    images = [read_image(file.read_bytes(), str(file)) for file in files]
    return [_part(path.name, tables["vertex"], tables["face"], images, ignored)], ignored


def _header(data: bytes) -> tuple[str, dict[str, _Element], list[str], int]:
    """The byte order ("" for text), the elements, the textures' names, the first data byte."""
    end = data.find(b"end_header")
    start = data.find(b"\n", end) + 1
    if not data.startswith(b"ply") or end < 0 or start == 0:
        raise UnreadableError("it has no PLY header")
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
                raise UnreadableError(f"its header says {line!r:.60}")
    if order is None or any(e.count < 0 for e in elements.values()):
        raise UnreadableError("its header names no format, or fewer than 0 rows")
    return order, elements, textures, start


def _table(source: _Text | _Binary, element: _Element) -> _Rows:
    """An element's rows.

    All rows are read at once if every list is as long as in the first row, else one by one.
    """
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
    except UnreadableError:
        # Lists of several lengths; or damage, which reading row by row will report.
        source.at = start
        return _uneven_table(source, element)
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
            rows.lists[name] = (np.full(element.count, first[name]), flat)
    return rows


def _uneven_table(source: _Text | _Binary, element: _Element) -> _Rows:
    """An element's rows, read one by one."""
    by_name: dict[str, list[np.ndarray]] = {name: [] for name in element.types}
    for _ in range(element.count):
        for name, values in _row(source, element):
            by_name[name].append(values)
    rows = _Rows()
    for name, values in by_name.items():
        if name in element.counts:
            rows.lists[name] = (np.array([len(v) for v in values]), np.concatenate(values))
        else:
            rows.columns[name] = np.concatenate(values)
    return rows


def _row(source: _Text | _Binary, element: _Element) -> Iterator[tuple[str, np.ndarray]]:
    """The properties of the next row: their names and numbers, one or a list's."""
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
    """The part of a file's vertices and faces; adds to `ignored` what is left out."""
    vertices = vertex.stacked(("x", "y", "z"))
    index_names = [key for key in ("vertex_indices", "vertex_index") if key in face.lists]
    if vertices is None or not index_names:
        raise UnreadableError("it has no x, y, z of vertices, or no vertex_indices of faces")
    sizes, corners = face.lists[index_names[0]]
    if len(corners) and not 0 <= corners.min() <= corners.max() < len(vertices):
        raise UnreadableError(
            f"faces have vertices {corners.min()} to {corners.max()} of {len(vertices)}"
        )
    if (sizes < 3).any():
        raise UnreadableError(f"a face has {sizes.min()} corners")
    triangles, owner, crossing = triangulate(vertices[corners], sizes)
    if crossing:
        ignored.add(f"the triangulation of {crossing} polygons that intersect themselves")
    faces = corners[triangles].astype(np.intp)
    colors, uv = _colors(vertex), _uv(vertex, face, sizes)
    if colors is not None:
        colors = colors[faces]
    elif (face_colors := _colors(face)) is not None:
        colors = np.repeat(face_colors[owner][:, None], 3, axis=1)
    normals = vertex.stacked(("nx", "ny", "nz"))
    if uv is not None:
        is_per_corner = len(uv) == len(corners) and "texcoord" in face.lists
        uv = uv[triangles] if is_per_corner else uv[faces]
    material = UNASSIGNED if colors is None else Material()
    materials, face_materials = [material], np.zeros(len(faces), np.intp)
    if images and uv is None:
        raise UnreadableError("it names a texture, and has no texture coordinates")
    if images:
        materials = [Material(texture=image) for image in images]
        if "texnumber" in face.columns:
            face_materials = face.columns["texnumber"][owner].astype(np.intp)
        is_index = (face_materials >= 0) & (face_materials < len(images))
        if not is_index.all():
            number = face_materials.max()
            raise UnreadableError(f"a face has texnumber {number} of {len(images)}")
    return Part(
        vertices,
        faces,
        materials,
        face_materials,
        [name],
        np.zeros(len(faces), np.intp),
        None if normals is None else unit(normals)[faces],
        uv,
        None,
        colors,
    )


def _colors(rows: _Rows) -> Float[np.ndarray, "row 3"] | None:
    """Linear RGB of an element's sRGB colours; None where it has none."""
    for names in _COLORS:
        if not all(name in rows.columns for name in names):
            continue
        values = np.stack([_in_unit_range(name, rows.columns[name]) for name in names], axis=1)
        return linear_from_srgb(values)
    return None


def _in_unit_range(name: str, codes: Num[np.ndarray, " row"]) -> Float[np.ndarray, " row"]:
    """A colour channel in [0, 1]: unsigned integers over their type's largest, or floats."""
    if codes.dtype.kind == "i":
        raise UnreadableError(f"{name} is of type {codes.dtype}, whose white is unknown")
    values = codes / (np.iinfo(codes.dtype).max if codes.dtype.kind == "u" else 1)
    if not ((values >= 0) & (values <= 1)).all():
        raise UnreadableError(f"{name} of type {codes.dtype} is not in [0, 1]")
    return values.astype(np.float64)


def _uv(
    vertex: _Rows, face: _Rows, sizes: Int[np.ndarray, " face"]
) -> Float[np.ndarray, "place 2"] | None:
    """Texture coordinates of all corners of the faces, else of all vertices, else None."""
    if "texcoord" in face.lists:
        lengths, flat = face.lists["texcoord"]
        if not np.array_equal(lengths, 2 * sizes):
            raise UnreadableError("texcoord must hold two numbers for each corner of a face")
        return flat.reshape(-1, 2).astype(np.float64)
    candidates = [vertex.stacked(names) for names in _COORDINATES]
    return next((uv for uv in candidates if uv is not None), None)
