"""The JSON of a glTF file, and the accessors, images and resources that it refers to.

Source: glTF 2.0 (Khronos 2017), 3.6, 3.8.3 and 4.4.
"""

import base64
import binascii
import json
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

import numpy as np

from jaxfx.scene._part import UnreadableError
from jaxfx.scene.formats._images import find_file


# NumPy's types by `componentType`, and the numbers per row by `type`.
_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
# The types of a GLB file's chunks.
_JSON, _BINARY = 0x4E4F534A, 0x004E4942
# Most rows of an accessor without a bufferView, which are zeros. Its `count` alone decides how
# much memory they take: without a limit a damaged file could ask for all of it.
_MAX_ZERO_ROWS = 1 << 26
# Stands for "no default": the key must be there.
_REQUIRED: Any = object()
# How far a ratio may lie outside [0, 1] and still be taken for rounding, not for an error.
ROUNDING = 1e-3


def is_glb(data: bytes) -> bool:
    """Whether a file is GLB, the binary form of glTF."""
    return data.startswith(b"glTF")


def take(record: Any, key: str, kind: type, default: Any = _REQUIRED) -> Any:
    """`record[key]`, which must be of the Python type `kind`; 3.0 passes for the integer 3."""
    if not isinstance(record, dict):
        raise UnreadableError(f"what should hold {key!r} is {record!r:.60}")
    if key not in record:
        if default is _REQUIRED:
            raise UnreadableError(f"{key!r} is missing in {record!r:.60}")
        return default
    value = record[key]
    if kind is int and isinstance(value, float) and value.is_integer():
        value = int(value)
    kinds = (int, float) if kind is float else kind
    if not isinstance(value, kinds) or (isinstance(value, bool) and kind is not bool):
        raise UnreadableError(f"{key!r} must be {kind.__name__}, got {value!r:.60}")
    return value


def vector(record: Any, key: str, default: list[float]) -> np.ndarray:
    """`record[key]`: a list of finite numbers, as long as `default`."""
    values = take(record, key, list, default)
    is_number = [isinstance(v, int | float) and not isinstance(v, bool) for v in values]
    if len(values) != len(default) or not all(is_number) or not np.isfinite(values).all():
        raise UnreadableError(f"{key!r} must be {len(default)} numbers, got {values!r:.60}")
    return np.array(values, np.float64)


def ratio(record: Any, key: str, default: float) -> float:
    """`record[key]`: a number in [0, 1]. What rounding has put outside is clamped."""
    value = take(record, key, float, default)
    if not -ROUNDING <= value <= 1 + ROUNDING:
        raise UnreadableError(f"{key!r} must be in [0, 1], got {value}")
    return min(max(float(value), 0.0), 1.0)


class Document:
    """A glTF file: its JSON, and access to what that refers to.

    `ignored` collects the names of what the readers leave out.
    """

    def __init__(self, path: Path, data: bytes):
        self.folder = path.parent
        self.ignored: set[str] = set()
        text, self.binary = _chunks(data) if is_glb(data) else (data, None)
        self.json = json.loads(text.decode("utf-8"), parse_constant=_refuse)
        version = take(take(self.json, "asset", dict), "version", str)
        least = take(self.json["asset"], "minVersion", str, "2.0")
        if version.split(".")[0] != "2" or least not in ("2.0", "2"):
            raise UnreadableError(f"it is of glTF version {version}; only 2.0 is read")
        self._buffers: dict[int, bytes] = {}

    def item(self, kind: str, index: Any) -> dict:
        """Entry `index` of the top-level list `kind`, such as "nodes"."""
        entries = take(self.json, kind, list, [])
        if isinstance(index, float) and index.is_integer():
            index = int(index)
        is_index = isinstance(index, int) and not isinstance(index, bool)
        if not is_index or not 0 <= index < len(entries):
            raise UnreadableError(f"there is no entry {index!r} in {kind!r} of {len(entries)}")
        if not isinstance(entries[index], dict):
            raise UnreadableError(f"entry {index} of {kind!r} is {entries[index]!r:.60}")
        return entries[index]

    def extensions(self, record: dict, *supported: str) -> dict:
        """A record's extensions; the names of all but `supported` are added to `ignored`."""
        extensions = take(record, "extensions", dict, {})
        self.ignored.update(set(extensions) - set(supported))
        return extensions

    def accessor(self, index: Any, *, widths: tuple[int, ...]) -> np.ndarray:
        """An accessor's rows, count x width: stored integers, or finite float64."""
        record = self.item("accessors", index)
        dtype = self._dtype(record)
        width = _WIDTHS.get(take(record, "type", str))
        count = take(record, "count", int)
        if width not in widths or count < 1:
            raise UnreadableError(f"accessor {index} is {count} of {record['type']!r}")
        if "bufferView" in record:
            offset = take(record, "byteOffset", int, 0)
            rows = self._rows(record["bufferView"], offset, count, width, dtype)
        elif count > _MAX_ZERO_ROWS:
            raise UnreadableError(f"accessor {index} has {count} rows and no bufferView")
        else:
            rows = np.zeros((count, width), dtype)
        if "sparse" in record:
            rows = self._replaced(rows, take(record, "sparse", dict))
        if take(record, "normalized", bool, False) and dtype.kind != "f":
            rows = np.maximum(rows / np.iinfo(dtype).max, -1)
        if rows.dtype.kind == "f":
            rows = rows.astype(np.float64)
            if not np.isfinite(rows).all():
                raise UnreadableError(f"accessor {index} holds numbers that are not finite")
        return rows

    def _replaced(self, rows: np.ndarray, sparse: dict) -> np.ndarray:
        """`rows` with the substitutions of a sparse accessor applied."""
        count = take(sparse, "count", int)
        index_record, value_record = (take(sparse, key, dict) for key in ("indices", "values"))

        def read(record: dict, width: int, dtype: np.dtype) -> np.ndarray:
            if "byteStride" in self.item("bufferViews", record.get("bufferView")):
                raise UnreadableError("sparse values must lie side by side, without byteStride")
            offset = take(record, "byteOffset", int, 0)
            return self._rows(take(record, "bufferView", int), offset, count, width, dtype)

        index = read(index_record, 1, self._dtype(index_record))
        values = read(value_record, rows.shape[1], rows.dtype)
        if index.dtype.kind != "u" or (index.size and index.max() >= len(rows)):
            raise UnreadableError(f"sparse values for {len(rows)} rows are at {index.max()}")
        rows = rows.copy()
        rows[index[:, 0]] = values
        return rows

    def _dtype(self, record: dict) -> np.dtype:
        """NumPy's type for a record's `componentType`."""
        kind = take(record, "componentType", int)
        if kind not in _COMPONENTS:
            raise UnreadableError(f"there is no componentType {kind}")
        return np.dtype(_COMPONENTS[kind])

    def _rows(
        self, view: Any, offset: int, count: int, width: int, dtype: np.dtype
    ) -> np.ndarray:
        """`count` rows of `width` numbers in a bufferView, from byte `offset` on."""
        memory, stride = self._view(view)
        size = width * dtype.itemsize
        step = size if stride is None else stride
        end = offset + (count - 1) * step + size
        if count < 0 or offset < 0 or step < size or end > len(memory):
            raise UnreadableError(
                f"{count} rows of {size} bytes, {step} apart, from {offset} on do not lie in "
                f"bufferView {view} of {len(memory)} bytes"
            )
        shape, strides = (count, width), (step, dtype.itemsize)
        return np.ndarray(shape, dtype, memory, offset, strides)

    def _view(self, index: Any) -> tuple[memoryview, int | None]:
        """A bufferView's bytes, and its stride in bytes where it states one."""
        record = self.item("bufferViews", index)
        extensions = ", ".join(self.extensions(record))
        data = self._buffer(record.get("buffer"), extensions)
        offset, length = take(record, "byteOffset", int, 0), take(record, "byteLength", int)
        if offset < 0 or length < 1 or offset + length > len(data):
            raise UnreadableError(
                f"bufferView {index} has {length} bytes from {offset} on, in {len(data)}"
            )
        stride = take(record, "byteStride", int, None)
        return memoryview(data)[offset : offset + length], stride

    def _buffer(self, index: Any, extensions: str) -> bytes:
        """A buffer's bytes; `extensions`, the bufferView's, are named where there are none."""
        record = self.item("buffers", index)
        if index not in self._buffers:
            if "uri" in record:
                data, _ = self.resource(take(record, "uri", str))
            elif self.binary is not None and index == 0:
                data = self.binary
            else:
                hint = f" but by {extensions}, which is not read" if extensions else ""
                raise UnreadableError(f"buffer {index} has no data{hint}")
            length = take(record, "byteLength", int)
            if length > len(data):
                raise UnreadableError(
                    f"buffer {index} must have {length} bytes, got {len(data)}"
                )
            self._buffers[index] = data[:length]
        return self._buffers[index]

    def image(self, index: Any) -> tuple[bytes, str]:
        """The bytes of an image file, and a name for it."""
        record = self.item("images", index)
        if "uri" in record:
            return self.resource(take(record, "uri", str))
        data, _ = self._view(take(record, "bufferView", int))
        return bytes(data), take(record, "name", str, f"images[{index}]")

    def resource(self, uri: str) -> tuple[bytes, str]:
        """The bytes that a URI refers to, and a name: a data URI, or a file beside this one."""
        scheme, separator, body = uri.partition(":")
        if scheme.lower() == "data" and separator:
            media_type, comma, code = body.partition(",")
            if not comma:
                raise UnreadableError(f"the URI {uri!r:.40} has no data")
            if not media_type.endswith(";base64"):
                return unquote_to_bytes(code), f"data:{media_type}"
            try:
                return base64.b64decode(unquote(code), validate=True), f"data:{media_type}"
            except binascii.Error as error:
                raise UnreadableError(f"the URI {uri!r:.40} is not base64: {error}") from error
        if body.startswith("//"):
            raise UnreadableError(f"{uri!r} is not a file beside this one")
        return find_file(self.folder, unquote(uri), uri).read_bytes(), unquote(uri)


def _refuse(constant: str) -> float:
    """Refuse NaN and Infinity, which Python's JSON accepts and glTF does not."""
    raise UnreadableError(f"its JSON holds {constant}")


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    """The JSON of a GLB file, and its binary chunk or None."""
    if len(data) < 12:
        raise UnreadableError(f"it has {len(data)} bytes, fewer than the 12 of a GLB header")
    _, version, length = struct.unpack_from("<4sII", data)
    if version != 2 or length > len(data):
        raise UnreadableError(
            f"it is GLB version {version} of {length} bytes; only version 2 is read, and the "
            f"file has {len(data)} bytes"
        )
    chunks, at = [], 12
    while at < length:
        if at + 8 > length:
            raise UnreadableError(f"it ends within the header of chunk {len(chunks)}")
        size, kind = struct.unpack_from("<II", data, at)
        if at + 8 + size > length:
            raise UnreadableError(f"chunk {len(chunks)} of {size} bytes goes on past its end")
        chunks.append((kind, data[at + 8 : at + 8 + size]))
        at += 8 + size
    if not chunks or chunks[0][0] != _JSON:
        raise UnreadableError("its first chunk is not JSON")
    return chunks[0][1], next((body for kind, body in chunks[1:2] if kind == _BINARY), None)
