"""Materials and textures of glTF files.

Source: glTF 2.0 (Khronos 2017), 3.8, 3.9 and 5.19; KHR_texture_transform.
"""

from typing import Any, NamedTuple

import numpy as np

from jaxfx.scene._material import Material, Sampler
from jaxfx.scene._part import UnreadableError
from jaxfx.scene.formats._gltf_document import ROUNDING, Document, ratio, take, vector
from jaxfx.scene.formats._images import read_image


# OpenGL's codes for wrap modes and for magnification filters (True: the nearest texel).
_WRAPS = {10497: "repeat", 33648: "mirror", 33071: "clamp"}
_FILTERS = {9728: True, 9729: False}
_TRANSFORM, _WEBP = "KHR_texture_transform", "EXT_texture_webp"
_GLOSSY = "KHR_materials_pbrSpecularGlossiness"
# The extensions that are read here.
EXTENSIONS = (_TRANSFORM, _WEBP)
# Between texture coordinates with v pointing down, as glTF has them, and up, as `Scene` does.
_FLIP = np.array([[1.0, 0, 0], [0, -1, 1], [0, 0, 1]])


class UsedMaterial(NamedTuple):
    """A material, and the file's sets of texture coordinates that it uses.

    `sets` holds the numbers of at most two sets: those for the scene's `uv` and `second_uv`.
    """

    material: Material
    sets: tuple[int, ...]


class Materials:
    """The materials of a document; each is built once, and each image decoded once."""

    def __init__(self, document: Document):
        self.document = document
        self._materials: dict[int | None, UsedMaterial] = {}
        self._images: dict[int, Any] = {}

    def get(self, index: int | None) -> UsedMaterial:
        """Material `index`; None is the standard's default, white metal of roughness 1."""
        if index not in self._materials:
            record = {} if index is None else self.document.item("materials", index)
            self._materials[index] = self._build(record)
        return self._materials[index]

    def _build(self, record: dict) -> UsedMaterial:
        """The material of an entry of "materials"."""
        extensions = self.document.extensions(record)
        if _GLOSSY in extensions and "pbrMetallicRoughness" not in record:
            raise UnreadableError(f"a material has {_GLOSSY} alone, which is not read")
        self._note_omissions(record)
        surface = take(record, "pbrMetallicRoughness", dict, {})
        self.document.extensions(surface)
        infos = {
            "texture": take(surface, "baseColorTexture", dict, None),
            "metallic_roughness": take(surface, "metallicRoughnessTexture", dict, None),
            "normal_map": take(record, "normalTexture", dict, None),
        }
        infos = {name: info for name, info in infos.items() if info is not None}
        coordinates = {name: self._coordinates(info) for name, info in infos.items()}
        sets = tuple(sorted({number for number, _ in coordinates.values()}))
        if len(sets) > 2:
            raise UnreadableError(f"a material reads texture coordinates {sets}, more than two")
        images, samplers = {}, {}
        for name, info in infos.items():
            number, transform = coordinates[name]
            images[name], wrap, nearest = self._texture(info)
            samplers[name] = Sampler(wrap, nearest, transform, sets.index(number) > 0)
        color = vector(surface, "baseColorFactor", [1.0] * 4)[:3]
        if (color < 0).any() or (color > 1 + ROUNDING).any():
            raise UnreadableError(f"'baseColorFactor' must be in [0, 1], got {color}")
        normal = infos.get("normal_map", {})
        material = Material(
            color=tuple(np.minimum(color, 1).tolist()),
            metallic=ratio(surface, "metallicFactor", 1.0),
            roughness=ratio(surface, "roughnessFactor", 1.0),
            normal_scale=float(take(normal, "scale", float, 1.0)),
            samplers=samplers,
            shader="ggx",
            **images,
        )
        return UsedMaterial(material, sets)

    def _note_omissions(self, record: dict) -> None:
        """Add the features of a material that are not read to the document's `ignored`."""
        ignored = self.document.ignored
        if "occlusionTexture" in record:
            ignored.add("occlusion")
        if "emissiveTexture" in record or vector(record, "emissiveFactor", [0.0] * 3).any():
            ignored.add("emission")
        if take(record, "alphaMode", str, "OPAQUE") != "OPAQUE":
            ignored.add("alpha")

    def _coordinates(self, info: dict) -> tuple[int, tuple[tuple[float, ...], ...]]:
        """The number of a texture's coordinate set, and the transform for its `Sampler`."""
        changes = self.document.extensions(info, _TRANSFORM).get(_TRANSFORM, {})
        number = take(changes, "texCoord", int, take(info, "texCoord", int, 0))
        if number < 0:
            raise UnreadableError(f"'texCoord' must be from 0, got {number}")
        x, y = vector(changes, "scale", [1.0, 1.0])
        angle = take(changes, "rotation", float, 0.0)
        cosine, sine = np.cos(angle), np.sin(angle)
        matrix = np.eye(3)
        matrix[:2, :2] = [[cosine * x, sine * y], [-sine * x, cosine * y]]
        matrix[:2, 2] = vector(changes, "offset", [0.0, 0.0])
        transform = (_FLIP @ matrix @ _FLIP)[:2]
        return number, tuple(map(tuple, transform.tolist()))

    def _texture(self, info: dict) -> tuple[np.ndarray, tuple[str, str], bool]:
        """A texture's image, its wrap modes, and whether the nearest texel is sampled."""
        record = self.document.item("textures", take(info, "index", int))
        extensions = self.document.extensions(record, _WEBP)
        source = record.get("source")
        if _WEBP in extensions:
            source = take(extensions[_WEBP], "source", int)
        if source is None:
            holder = ", ".join(extensions) or "nothing"
            raise UnreadableError(f"a texture's image is held by {holder}, which is not read")
        if source not in self._images:
            self._images[source] = read_image(*self.document.image(source))
        sampler = {}
        if "sampler" in record:
            sampler = self.document.item("samplers", record["sampler"])
        wraps = [take(sampler, key, int, 10497) for key in ("wrapS", "wrapT")]
        mag_filter = take(sampler, "magFilter", int, 9729)
        if not set(wraps) <= _WRAPS.keys() or mag_filter not in _FILTERS:
            raise UnreadableError(f"a sampler has wraps {wraps} and magFilter {mag_filter}")
        along_u, along_v = (_WRAPS[wrap] for wrap in wraps)
        return self._images[source], (along_u, along_v), _FILTERS[mag_filter]
