"""glTF files as JSON with the numbers and images that it points to.

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

from jaxfx.scene._images import find_file
from jaxfx.scene._part import UnreadableError


_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_JSON, _BINARY = 0x4E4F534A, 0x004E4942
_MOST_IMPLICIT = 1 << 26  # rows of an accessor that no buffer holds
_NEEDED: Any = object()


def is_glb(data: bytes) -> bool:
    """Whether a file is of the binary kind."""
    return data.startswith(b"glTF")


def take(record: Any, key: str, kind: type, default: Any = _NEEDED) -> Any:
    """`record[key]`, of the JSON type that `kind` is in Python; whole numbers are int."""
    if not isinstance(record, dict):
        raise UnreadableError(f"what should hold {key!r} is {record!r:.60}")
    if key not in record:
        if default is _NEEDED:
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
    """`record[key]`, as many finite numbers as `default` has."""
    values = take(record, key, list, default)
    is_number = [isinstance(v, int | float) and not isinstance(v, bool) for v in values]
    if len(values) != len(default) or not all(is_number) or not np.isfinite(values).all():
        raise UnreadableError(f"{key!r} must be {len(default)} numbers, got {values!r:.60}")
    return np.array(values, np.float64)


def share(record: Any, key: str, default: float) -> float:
    """`record[key]`, a number from 0 to 1 but for rounding."""
    value = take(record, key, float, default)
    if not -1e-3 <= value <= 1 + 1e-3:
        raise UnreadableError(f"{key!r} must be in [0, 1], got {value}")
    return min(max(float(value), 0.0), 1.0)


class Document:
    """A file's JSON, its numbers and its images. `ignored` gathers what is left out."""

    def __init__(self, path: Path, data: bytes):
        self.folder = path.parent
        self.ignored: set[str] = set()
        text, self.binary = _chunks(data) if is_glb(data) else (data, None)
        self.json = json.loads(text.decode("utf-8"), parse_constant=_refuse)
        version = take(take(self.json, "asset", dict), "version", str)
        least = take(self.json["asset"], "minVersion", str, "2.0")
        if version.split(".")[0] != "2" or least not in ("2.0", "2"):
            raise UnreadableError(f"it is of glTF version {version}, read is 2.0")
        self._buffers: dict[int, bytes] = {}

    def item(self, kind: str, index: Any) -> dict:
        """Entry `index` of the list that is called `kind`."""
        entries = take(self.json, kind, list, [])
        if isinstance(index, float) and index.is_integer():
            index = int(index)
        is_index = isinstance(index, int) and not isinstance(index, bool)
        if not is_index or not 0 <= index < len(entries):
            raise UnreadableError(f"there is no entry {index!r} in {kind!r} of {len(entries)}")
        if not isinstance(entries[index], dict):
            raise UnreadableError(f"entry {index} of {kind!r} is {entries[index]!r:.60}")
        return entries[index]

    def extensions(self, record: dict, *known: str) -> dict:
        """A record's extensions; those but `known` are left out."""
        found = take(record, "extensions", dict, {})
        self.ignored.update(set(found) - set(known))
        return found

    def accessor(self, index: Any, *, widths: tuple[int, ...]) -> np.ndarray:
        """An accessor's rows: integers as they are stored, or float64; all of them finite."""
        record = self.item("accessors", index)
        dtype = self._dtype(record)
        width = _WIDTHS.get(take(record, "type", str))
        count = take(record, "count", int)
        if width not in widths or count < 1:
            raise UnreadableError(f"accessor {index} is {count} of {record['type']!r}")
        if "bufferView" in record:
            offset = take(record, "byteOffset", int, 0)
            rows = self._rows(record["bufferView"], offset, count, width, dtype)
        elif count > _MOST_IMPLICIT:
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
        """`rows` with those that a sparse accessor names."""
        count = take(sparse, "count", int)
        place, value = (take(sparse, key, dict) for key in ("indices", "values"))
        for each in (place, value):
            if "byteStride" in self.item("bufferViews", each.get("bufferView")):
                raise UnreadableError("sparse values must lie side by side, without byteStride")
        where, what = (
            self._rows(
                take(each, "bufferView", int),
                take(each, "byteOffset", int, 0),
                count,
                width,
                dtype,
            )
            for each, width, dtype in (
                (place, 1, self._dtype(place)),
                (value, rows.shape[1], rows.dtype),
            )
        )
        if where.dtype.kind != "u" or (where.size and where.max() >= len(rows)):
            raise UnreadableError(f"sparse values for {len(rows)} rows are at {where.max()}")
        rows = rows.copy()
        rows[where[:, 0]] = what
        return rows

    def _dtype(self, record: dict) -> np.dtype:
        kind = take(record, "componentType", int)
        if kind not in _COMPONENTS:
            raise UnreadableError(f"there is no componentType {kind}")
        return np.dtype(_COMPONENTS[kind])

    def _rows(
        self, view: Any, offset: int, count: int, width: int, dtype: np.dtype
    ) -> np.ndarray:
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
        """A bufferView's bytes and stride."""
        record = self.item("bufferViews", index)
        packed = ", ".join(self.extensions(record))
        data = self._buffer(record.get("buffer"), packed)
        offset, length = take(record, "byteOffset", int, 0), take(record, "byteLength", int)
        if offset < 0 or length < 1 or offset + length > len(data):
            raise UnreadableError(
                f"bufferView {index} has {length} bytes from {offset} on, in {len(data)}"
            )
        stride = take(record, "byteStride", int, None)
        return memoryview(data)[offset : offset + length], stride

    def _buffer(self, index: Any, packed: str) -> bytes:
        record = self.item("buffers", index)
        if index not in self._buffers:
            if "uri" in record:
                data, _ = self.resource(take(record, "uri", str))
            elif self.binary is not None and index == 0:
                data = self.binary
            else:
                only = f" but by {packed}, which is not read" if packed else ""
                raise UnreadableError(f"buffer {index} has no data{only}")
            length = take(record, "byteLength", int)
            if length > len(data):
                raise UnreadableError(
                    f"buffer {index} must have {length} bytes, got {len(data)}"
                )
            self._buffers[index] = data[:length]
        return self._buffers[index]

    def image(self, index: Any) -> tuple[bytes, str]:
        """An image's file and its name."""
        record = self.item("images", index)
        if "uri" in record:
            return self.resource(take(record, "uri", str))
        data, _ = self._view(take(record, "bufferView", int))
        return bytes(data), take(record, "name", str, f"images[{index}]")

    def resource(self, uri: str) -> tuple[bytes, str]:
        """What a URI names, and that name: data within it, or a file beside this one."""
        head, separator, body = uri.partition(":")
        if head.lower() == "data" and separator:
            kind, comma, code = body.partition(",")
            if not comma:
                raise UnreadableError(f"the URI {uri!r:.40} has no data")
            if not kind.endswith(";base64"):
                return unquote_to_bytes(code), f"data:{kind}"
            try:
                return base64.b64decode(unquote(code), validate=True), f"data:{kind}"
            except binascii.Error as error:
                raise UnreadableError(f"the URI {uri!r:.40} is not base64: {error}") from error
        if body.startswith("//"):
            raise UnreadableError(f"{uri!r} is not a file beside this one")
        return find_file(self.folder, unquote(uri), uri).read_bytes(), unquote(uri)


def _refuse(constant: str) -> float:
    raise UnreadableError(f"its JSON holds {constant}")


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    """The JSON and the binary chunk of a GLB file."""
    if len(data) < 12:
        raise UnreadableError(f"it has {len(data)} bytes, the head of a GLB file 12")
    _, version, length = struct.unpack_from("<4sII", data)
    if version != 2 or length > len(data):
        raise UnreadableError(
            f"it is GLB version {version} of {length} bytes, read is version 2, got {len(data)}"
        )
    chunks, at = [], 12
    while at < length:
        if at + 8 > length:
            raise UnreadableError(f"it ends within the head of chunk {len(chunks)}")
        size, kind = struct.unpack_from("<II", data, at)
        if at + 8 + size > length:
            raise UnreadableError(f"chunk {len(chunks)} of {size} bytes goes on past its end")
        chunks.append((kind, data[at + 8 : at + 8 + size]))
        at += 8 + size
    if not chunks or chunks[0][0] != _JSON:
        raise UnreadableError("its first chunk is not JSON")
    return chunks[0][1], next((body for kind, body in chunks[1:2] if kind == _BINARY), None)
