"""Which layers of an EXR file are images and depths, by the names that renderers give.

`jaxfx.io` uses `images_of`, `depths_of`, `choose_image`, `choose` and `flat` for EXR files.
"""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxfx import depth as depths
from jaxfx._files import StrPath
from jaxfx.exr._parts import MAX_PIXELS, full_names, planes_of, read_parts
from jaxfx.exr.layers import assemble


# The names of passes that hold the image and the depth, in order of preference.
_IMAGE = ("combined", "rgba", "rgb", "color", "beauty")
_DEPTH = ("depth", "z", "zdepth")


class RGBD(NamedTuple):
    """An image and its depth, of the same pixels: what `read_rgbd` returns.

    - `image`: height width channel, linear, float32.
    - `depth`: height width, in the file's units, along the axis; NaN where it is missing, inf
      for background.
    """

    image: Float[np.ndarray, "height width channel"]
    depth: Float[np.ndarray, "height width"]


def read_rgbd(
    path: StrPath,
    *,
    layer: str | None = None,
    max_pixels: int = MAX_PIXELS,
    verify: bool = True,
) -> RGBD:
    """Read an image and its depth from one EXR file, such as Blender's multilayer EXR.

    A second layer of depth, for `dof.layered(behind=...)`, is a second call with another
    `layer`.

    **Arguments:**

    - `path`: the file.
    - `layer`: the layer, which is the prefix of the passes' names: `"ViewLayer"`, or with a
      view `"ViewLayer.left"`. None takes passes without a prefix (those of the first view), or
      the only layer with an image and a depth, or the only image and the only depth.
    - `max_pixels`, `verify`: as for `read`.

    **Returns:** `RGBD(image, depth)`, both float32: `image`, height width channel, linear, with
    the file's channels (1, 3 or 4, alpha premultiplied); `depth`, height width, in the file's
    units along the axis, NaN where it is missing, inf for background, which Blender writes as
    1e10 or, in half precision, 65504 (as `depth.clean`).

    **Raises:** `ValueError` and `OSError`, as `read`; it names the layers of the file where
    none or several fit, and where image and depth are not of the same pixels.

    **Gradient:** none; the host side.

    **Example:**

    >>> import numpy as np
    >>> from jaxfx import exr
    >>> passes = {"ViewLayer.Combined": np.zeros((6, 8, 3)), "ViewLayer.Depth": np.ones((6, 8))}
    >>> exr.write("render.exr", passes)
    >>> image, depth = exr.read_rgbd("render.exr", layer="ViewLayer")
    >>> image.shape, depth.shape
    ((6, 8, 3), (6, 8))

    The image is a layer's pass `Combined` (or `rgba`, `rgb`, `color`, `beauty`, or channels
    directly in the layer), the depth its pass `Depth` (or `Z`, `zdepth`), in any letter case.
    """
    parts = read_parts(path, max_pixels, verify)
    channels = full_names(path, parts)
    layers = assemble(path, planes_of(channels))
    images, named = images_of(layers)
    depth_keys = depths_of(layers)
    # Passes without a prefix belong to the first view, whose name prefixes the others.
    first_view = next(iter(parts[0].header.get("multiView", [])), "")
    if view := parts[0].header.get("view", first_view):
        for keys_by_layer in (images, depth_keys):
            keys = [keys_by_layer[name] for name in ("", view) if name in keys_by_layer]
            if keys:
                keys_by_layer[""] = keys_by_layer[view] = keys[0]
    both = images.keys() & depth_keys.keys()
    if layer is None and not both and images and depth_keys:
        # Image and depth may be in different layers: an image without prefix, for instance.
        keys = (
            images[choose_image(path, images, named, None)],
            depth_keys[choose(path, "a depth", depth_keys, None)],
        )
    else:
        chosen = choose(path, "an image and a depth", both, layer, [*layers])
        keys = images[chosen], depth_keys[chosen]
    windows = [_windows(channels, key) for key in keys]
    if len(windows[0] | windows[1]) != 1:
        raise ValueError(
            f"`{path}` must have `{keys[0]}` and `{keys[1]}` in the same pixels, got the data "
            f"windows {sorted(windows[0] | windows[1])}."
        )
    image, depth = layers[keys[0]], flat(layers[keys[1]])
    return RGBD(image.astype(np.float32), np.asarray(depths.clean(depth.astype(np.float32))))


def _windows(channels: Mapping[str, tuple], key: str) -> set[tuple]:
    """The data windows of a layer's channels."""
    return {
        tuple(np.ravel(part.header["dataWindow"]).tolist())
        for full, (part, _) in channels.items()
        if key in (full, full.rpartition(".")[0])
    }


def images_of(layers: Mapping[str, np.ndarray]) -> tuple[dict[str, str], list[str]]:
    """The keys of arrays that are images, by layer; and the layers with a pass of `_IMAGE`."""
    keys = [key for key, a in layers.items() if a.ndim == 3 and a.shape[2] in (1, 3, 4)]
    named = _by_layer(keys, _IMAGE)
    return named | {key: key for key in keys if _layer_of(key, _IMAGE) is None}, [*named]


def depths_of(layers: Mapping[str, np.ndarray]) -> dict[str, str]:
    """The keys of arrays that are depths, by layer."""
    single = [key for key, a in layers.items() if flat(a).ndim == 2]
    return _by_layer(single, _DEPTH)


def flat(array: np.ndarray) -> np.ndarray:
    """`array` without its last axis where that has one channel."""
    return array[..., 0] if array.ndim == 3 and array.shape[2] == 1 else array


def _layer_of(key: str, words: Iterable[str]) -> tuple[str, str] | None:
    """A key split into its layer and its pass, which is one of `words`; None if it has none."""
    parts = key.split(".")
    for i, part in reversed([*enumerate(parts)]):
        if part.lower() in words:
            return ".".join(parts[:i] + parts[i + 1 :]), part.lower()
    return None


def _by_layer(keys: Iterable[str], words: tuple[str, ...]) -> dict[str, str]:
    """For each layer, the key of its pass that comes first in `words`."""
    by_layer: dict[str, str] = {}
    for word in reversed(words):
        for key in keys:
            if (split := _layer_of(key, words)) and split[1] == word:
                by_layer[split[0]] = key
    return by_layer


def choose_image(
    path: StrPath, images: Mapping[str, str], named: list[str], layer: str | None
) -> str:
    """The layer of the image: `layer`, or for None the one without a name, or the only one.

    `images` and `named` are those of `images_of`. For None, layers in `named` go first.
    """
    candidates = named if layer is None and "" not in images and named else images
    return choose(path, "an image", candidates, layer)


def choose(
    path: StrPath,
    what: str,
    names: Iterable[str],
    layer: str | None,
    others: Iterable[str] = (),
) -> str:
    """`layer` if it is in `names`; for None, the one without a name, or the only one.

    `ValueError` says that `path` lacks `what`; `others` are the layers that it has.
    """
    names = sorted(names)
    if layer is None and ("" in names or len(names) == 1):
        return names[0]
    if layer in names:
        return str(layer)
    wanted = "one layer" if layer is None else f"a layer `{layer}`"
    got = f"such layers: {names}" if names else f"none among {sorted(others)}"
    raise ValueError(f"`{path}` must have {wanted} with {what}, got {got}.")
