"""Materials and textures of glTF files.

Source: glTF 2.0 (Khronos 2017), 3.8, 3.9 and 5.19; KHR_texture_transform.
"""

from typing import Any, NamedTuple

import numpy as np

from jaxfx.scene._gltf_data import Document, share, take, vector
from jaxfx.scene._images import read_image
from jaxfx.scene._material import Material, Sampler
from jaxfx.scene._part import UnreadableError


_WRAPS = {10497: "repeat", 33648: "mirror", 33071: "clamp"}
_FILTERS = {9728: True, 9729: False}  # whether the nearest texel is taken
_TRANSFORM, _WEBP = "KHR_texture_transform", "EXT_texture_webp"
_GLOSSY = "KHR_materials_pbrSpecularGlossiness"
HONOURED = (_TRANSFORM, _WEBP)
_FLIP = np.array([[1.0, 0, 0], [0, -1, 1], [0, 0, 1]])  # v of glTF points down, ours up


class Reads(NamedTuple):
    """A material, and the texture coordinates that its `uv` and `second_uv` are."""

    material: Material
    sets: tuple[int, ...]


class Materials:
    """The materials of a document, each made once."""

    def __init__(self, document: Document):
        self.document = document
        self._made: dict[int | None, Reads] = {}
        self._images: dict[int, Any] = {}

    def get(self, index: int | None) -> Reads:
        """Material `index`; None is the standard's default, white metal of roughness 1."""
        if index not in self._made:
            record = {} if index is None else self.document.item("materials", index)
            self._made[index] = self._make(record)
        return self._made[index]

    def _make(self, record: dict) -> Reads:
        extra = self.document.extensions(record)
        if _GLOSSY in extra and "pbrMetallicRoughness" not in record:
            raise UnreadableError(f"a material is told by {_GLOSSY} alone, which is not read")
        self._note_omissions(record)
        surface = take(record, "pbrMetallicRoughness", dict, {})
        self.document.extensions(surface)
        infos = {
            "texture": take(surface, "baseColorTexture", dict, None),
            "metallic_roughness": take(surface, "metallicRoughnessTexture", dict, None),
            "normal_map": take(record, "normalTexture", dict, None),
        }
        infos = {name: info for name, info in infos.items() if info is not None}
        places = {name: self._place(info) for name, info in infos.items()}
        sets = tuple(sorted({number for number, _ in places.values()}))
        if len(sets) > 2:
            raise UnreadableError(f"a material reads texture coordinates {sets}, more than two")
        images, samplers = {}, {}
        for name, info in infos.items():
            number, transform = places[name]
            images[name], wrap, nearest = self._texture(info)
            samplers[name] = Sampler(wrap, nearest, transform, sets.index(number) > 0)
        color = vector(surface, "baseColorFactor", [1.0] * 4)[:3]
        if (color < 0).any() or (color > 1 + 1e-3).any():
            raise UnreadableError(f"'baseColorFactor' must be in [0, 1], got {color}")
        normal = infos.get("normal_map", {})
        material = Material(
            color=tuple(np.minimum(color, 1).tolist()),
            metallic=share(surface, "metallicFactor", 1.0),
            roughness=share(surface, "roughnessFactor", 1.0),
            normal_scale=float(take(normal, "scale", float, 1.0)),
            samplers=samplers,
            **images,
        )
        return Reads(material, sets)

    def _note_omissions(self, record: dict) -> None:
        ignored = self.document.ignored
        if "occlusionTexture" in record:
            ignored.add("occlusion")
        if "emissiveTexture" in record or vector(record, "emissiveFactor", [0.0] * 3).any():
            ignored.add("emission")
        if take(record, "alphaMode", str, "OPAQUE") != "OPAQUE":
            ignored.add("alpha")

    def _place(self, info: dict) -> tuple[int, tuple[tuple[float, ...], ...]]:
        """The number of a texture's coordinates, and their transform as `Sampler` has it."""
        moved = self.document.extensions(info, _TRANSFORM).get(_TRANSFORM, {})
        number = take(moved, "texCoord", int, take(info, "texCoord", int, 0))
        if number < 0:
            raise UnreadableError(f"'texCoord' must be from 0, got {number}")
        x, y = vector(moved, "scale", [1.0, 1.0])
        angle = take(moved, "rotation", float, 0.0)
        cosine, sine = np.cos(angle), np.sin(angle)
        matrix = np.eye(3)
        matrix[:2, :2] = [[cosine * x, sine * y], [-sine * x, cosine * y]]
        matrix[:2, 2] = vector(moved, "offset", [0.0, 0.0])
        turned = (_FLIP @ matrix @ _FLIP)[:2]
        return number, tuple(map(tuple, turned.tolist()))

    def _texture(self, info: dict) -> tuple[np.ndarray, tuple[str, str], bool]:
        """An image, its wraps, and whether the nearest texel is taken."""
        record = self.document.item("textures", take(info, "index", int))
        extra = self.document.extensions(record, _WEBP)
        source = record.get("source")
        if _WEBP in extra:
            source = take(extra[_WEBP], "source", int)
        if source is None:
            known = ", ".join(extra) or "nothing"
            raise UnreadableError(f"a texture has an image by {known} alone, which is not read")
        if source not in self._images:
            self._images[source] = read_image(*self.document.image(source))
        sampler = {}
        if "sampler" in record:
            sampler = self.document.item("samplers", record["sampler"])
        wraps = [take(sampler, key, int, 10497) for key in ("wrapS", "wrapT")]
        shape = take(sampler, "magFilter", int, 9729)
        if not set(wraps) <= _WRAPS.keys() or shape not in _FILTERS:
            raise UnreadableError(f"a sampler has wraps {wraps} and magFilter {shape}")
        along_u, along_v = (_WRAPS[wrap] for wrap in wraps)
        return self._images[source], (along_u, along_v), _FILTERS[shape]
