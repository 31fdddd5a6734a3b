"""MTL files: the materials of OBJ files.

Source: Wavefront's MTL, as in Bourke 1995.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxfx.io import linear_from_srgb
from jaxfx.scene._material import Material, Sampler
from jaxfx.scene._part import UNASSIGNED, UnreadableError
from jaxfx.scene.formats._images import find_file, read_image


# Statements that are read; those that exporters write for every material and that are skipped
# without a message unless they say more than the default. All others are reported.
_READ = {"kd", "ks", "ns", "illum", "map_kd"}
_SKIPPED = {"ka", "tf", "ni", "sharpness", "tr", "d", "ke", "km"}
# Options of a map: those with numbers, and how many at most; and those with one word each that
# are skipped without a message.
_NUMERIC_OPTIONS = {"-s": 3, "-o": 3, "-t": 3, "-mm": 2}
_SKIPPED_OPTIONS = {
    *("-blendu", "-blendv", "-texres", "-boost", "-imfchan", "-cc", "-bm", "-type"),
}


class Library:
    """The materials of an OBJ file's MTL files; each is built when it is first used.

    `ignored` collects the names of what is left out.
    """

    def __init__(self):
        self.ignored: set[str] = set()
        self._records: dict[str, tuple[Path, dict[str, str]]] = {}
        self._images: dict[Path, np.ndarray] = {}
        self._materials: dict[tuple[str, bool], Material] = {}

    def read(self, path: Path) -> None:
        """Add a file's materials. Of two with one name, the first is kept."""
        record: dict[str, str] | None = None
        for line in path.read_bytes().decode("utf-8-sig", "surrogateescape").splitlines():
            word, _, rest = " ".join(line.split("\t")).strip().partition(" ")
            key, rest = word.lower(), rest.strip()
            if not key or key.startswith("#"):
                continue
            if key == "newmtl":
                record = {}
                if self._records.setdefault(rest, (path, record))[1] is not record:
                    self.ignored.add(f"a second material {rest!r}")
            elif record is None:
                raise UnreadableError(f"{path.name!r} has {word!r} before any newmtl")
            elif key in _READ:
                record[key] = rest
            elif key not in _SKIPPED or _is_not_default(key, rest):
                self.ignored.add(f"{word} of materials")

    def __contains__(self, name: str) -> bool:
        return name in self._records

    def get(self, name: str, *, has_uv: bool) -> Material:
        """A material by name; without its texture where faces have no texture coordinates."""
        if (name, has_uv) not in self._materials:
            self._materials[name, has_uv] = self._build(name, has_uv)
        return self._materials[name, has_uv]

    def _build(self, name: str, has_uv: bool) -> Material:
        """The material of a record. `Ns` becomes the roughness sqrt(2 / (Ns + 2))."""
        path, record = self._records[name]
        texture, sampler = None, Sampler()
        if "map_kd" in record:
            file, sampler = _texture_map(record["map_kd"], path)
            texture = self._image(file) if has_uv else None
            if not has_uv:
                self.ignored.add(f"the texture of {name!r} on faces without vt")
        if "kd" in record:
            color = tuple(linear_from_srgb(_color(record, "kd")).tolist())
        else:
            color = (1.0, 1.0, 1.0) if "map_kd" in record else UNASSIGNED.color
        has_highlight = "ks" in record and _color(record, "ks").any()
        if "illum" in record:
            illumination = _numbers(record["illum"], "illum", 1, 1)[0]
            has_highlight = has_highlight and illumination not in (0, 1)
        exponent = 0.0
        if "ns" in record:
            stated = max(_numbers(record["ns"], "Ns", 1, 1)[0], 0.0)
            exponent = stated if has_highlight else 0.0
        return Material(
            color=color,
            texture=texture,
            roughness=float((2 / (exponent + 2)) ** 0.5),
            samplers={} if texture is None else {"texture": sampler},
        )

    def _image(self, path: Path) -> np.ndarray:
        """An image file's texels; each file is decoded once."""
        if path not in self._images:
            self._images[path] = read_image(path.read_bytes(), str(path))
        return self._images[path]


def _is_not_default(key: str, rest: str) -> bool:
    """Whether a skipped statement asks for something: opacity other than 1, or emission."""
    if key in ("d", "ke"):
        try:
            values = [float(word) for word in rest.split("#", maxsplit=1)[0].split()]
        except ValueError:
            return True
        return values[:1] != [1] if key == "d" else any(values)
    return False


def _numbers(text: str, name: str, least: int, most: int) -> list[float]:
    """From `least` to `most` finite numbers; `name` is the statement's, for errors."""
    words = text.split("#", maxsplit=1)[0].split()
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if not least <= len(values) <= most or not np.isfinite(values).all():
        raise UnreadableError(f"a material has {name} {text!r}, which is not read")
    return values


def _color(record: dict[str, str], key: str) -> Float[np.ndarray, "3"]:
    """A statement's colour: three numbers, or one for all three channels."""
    name = key.capitalize()
    values = _numbers(record[key], name, 1, 3)
    if len(values) == 2 or min(values) < 0:
        raise UnreadableError(f"a material has {name} {record[key]!r}, which is not read")
    return np.array(values if len(values) == 3 else values * 3)


def _texture_map(text: str, path: Path) -> tuple[Path, Sampler]:
    """The image file of a map statement, and the sampler that its options ask for."""
    numbers = {"-s": [1.0, 1.0], "-o": [0.0, 0.0], "-t": [0.0], "-mm": [0.0, 1.0]}
    clamp, rest = "off", text
    while rest.startswith("-"):
        option, _, after = rest.partition(" ")
        key = option.lower()
        if key not in _NUMERIC_OPTIONS and key not in _SKIPPED_OPTIONS and key != "-clamp":
            break  # A file name that begins with a dash.
        rest = after.strip()
        if key in _NUMERIC_OPTIONS:
            values = []
            while len(values) < _NUMERIC_OPTIONS[key]:
                word, _, after = rest.partition(" ")
                try:
                    values.append(float(word))
                except ValueError:
                    break
                rest = after.strip()
            if not values or not np.isfinite(values).all():
                raise UnreadableError(f"a map has {text!r}, with no number behind {option}")
            numbers[key] = values
        elif key == "-clamp":
            clamp, _, rest = rest.partition(" ")
        else:
            rest = rest.partition(" ")[2]
        rest = rest.strip()
    if any(numbers["-t"]) or numbers["-mm"] != [0, 1] or clamp not in ("on", "off"):
        raise UnreadableError(f"a map has {text!r}: its turbulence or range is not read")
    scale_u, scale_v = [*numbers["-s"], 1][:2]
    offset_u, offset_v = [*numbers["-o"], 0][:2]
    wrap = "clamp" if clamp == "on" else "repeat"
    transform = ((scale_u, 0, offset_u), (0, scale_v, offset_v))
    sampler = Sampler((wrap, wrap), transform=transform)
    if rest[:1] == rest[-1:] and rest[:1] in ("'", '"'):
        return find_file(path.parent, rest[1:-1], rest), sampler
    return find_file(path.parent, rest), sampler
