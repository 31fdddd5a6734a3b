"""Depth of field within an error."""

import math
from typing import Any, Literal, NamedTuple

import equinox as eqx
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float, Num

from jaxfx._arguments import check_lens
from jaxfx._checks import Number, check_depth, check_image, option
from jaxfx.budget._octaves import octaves
from jaxfx.budget._plan import Part, Plan, Search, Trial, check_call, plan
from jaxfx.dof._inputs import check_arguments, compiled, largest_coc, largest_of
from jaxfx.dof.blend import blend
from jaxfx.dof.diffusion import implicit_diffusion
from jaxfx.dof.gather import gather
from jaxfx.dof.layered import layered
from jaxfx.dof.scatter import cheapest, scatter
from jaxfx.dof.separable import separable
from jaxfx.lens import Lens


# From which size on to try sprites at lower resolutions, in pixels; not below 3 epsilon.
_SPLITS = (8.0, 10.0)
# Taps of gather, whose errors tell how many would do; more than so many are not tried.
_FEW, _MORE, _MOST = 4, 16, 64
# The parts that are tried: so many, of so many pixels a side or as wide as the largest circle,
# if they are less than this share of the picture; or else all of it.
_PARTS, _SIDE, _SHARE = 6, 64, 1 / 4


def _nothing(image: Any, depth: Any, lens: Any) -> Any:
    return check_image("dof(image)", image)


def _in_octaves(image: Any, depth: Any, lens: Any, **options: Any) -> Any:
    image, depth, lens, _ = check_arguments("dof", image, depth, lens, options["max_coc"])
    return octaves(image, depth, lens, **options)


_METHODS = {
    "nothing": _nothing,
    "scatter": scatter,
    "scatter in octaves": _in_octaves,
    "layered": layered,
    "separable": separable,
    "blend": blend,
    "implicit diffusion": implicit_diffusion,
    "gather": gather,
}
# Of scatter, direct taps against spans.
_KERNELS = {"tiles": "spans", "spans": "tiles"}
# What is tried beside the effect, its smaller circles, octaves and gather.
_OTHERS = ("separable", "implicit diffusion", "blend")


class Method(eqx.Module):
    """A method of depth of field and its options."""

    name: str = eqx.field(static=True)
    options: tuple[tuple[str, Any], ...] = eqx.field(static=True)

    def __init__(self, name: str, **options: Any):
        self.name, self.options = name, tuple(options.items())

    @property
    def title(self) -> str:
        """What it is."""
        return f"depth of field by {self.name}"

    def __call__(self, image: Any, depth: Any, lens: Any) -> Any:
        """As the effect."""
        return _METHODS[self.name](image, depth, lens, **dict(self.options))


def dof(
    image: Float[ArrayLike, "height width channel"],
    depth: Num[ArrayLike, "height width"],
    lens: Lens,
    *,
    max_error: Number,
    effect: Literal["scatter", "layered"] = "scatter",
) -> Plan:
    """The quickest depth of field within an error of `dof.scatter`.

    Where no circle of confusion passes its pixel, nothing is done, and nothing tried. Else the
    effect and cheaper ways are drawn on six tiles of this scene, which stand for as many groups
    of tiles that a blur changes alike, or on all of it where it is small: the picture as it is;
    circles no larger than a power of two (the smallest that will do is searched by halving);
    sprites wider than 8 or 10 pixels in octaves, the larger at the lower resolution; scatter's
    other kernel; the separable filter, diffusion, blending, layers; and gather, by as many taps
    as its variance asks for: from the errors of two numbers of taps follow the part that more
    taps can mend and the part that they can't. A way is dropped at the tile at which it errs
    too much or is too slow. Of the others the quickest is measured on the whole scene and, if
    its error holds there, taken; or else one that errs less, at the last the effect itself. The
    effect goes no farther in each tile than the largest circle that reaches it.

    It costs one rendering for the proof, one by the plan (two or three if the tiles misled),
    and about as much as another for the tiles; at first also a program for each way.

    **Arguments:**

    - `image`: height width channel, linear radiance.
    - `depth`: height width, scene units along the optical axis, inf for background; 0, negative
      or NaN where it is missing.
    - `lens`: gives each depth its signed defocus, in pixels.
    - `max_error`: root mean square, linear image units, over all pixels and channels.
    - `effect`: the effect that is approached: `dof.scatter` with `gamma=0`, `epsilon=2` and
      exact kernels, or `dof.layered`, from one layer.

    **Returns:** a `Plan`, to be called with `image, depth, lens`, of this scene or of others
    with no larger circles: those are drawn as large as this scene's largest.

    **Raises:** `ValueError` for a wrong shape, a negative `max_error`, an unknown `effect` or
    traced data.

    **Gradient:** none through the choice; the plan's picture has that of what it draws.
    """
    max_error = check_call("dof", max_error, (image, depth, lens))
    image = check_image("dof(image)", image)
    depth = check_depth("dof(depth)", depth, image.shape[:2])
    check_lens("dof(lens)", lens)
    option("dof(effect=...)", effect, ("scatter", "layered"))
    widest = largest_of("dof", depth, lens)
    if widest is None:
        raise ValueError("`dof(lens)` must be concrete, got a lens that holds traced values.")
    if widest <= 1 and effect == "scatter":
        why = f"no circle of confusion passes its pixel: the largest is {widest:.2g} pixels."
        return plan(Method("nothing"), 0.0, 0.0, float("nan"), [f"all, for {why}"])

    largest = largest_coc("dof", depth, lens)
    ways = _Ways(effect, (depth.shape[0], depth.shape[1]), largest)
    data = (image, depth, lens)
    search = Search(ways.effect(largest), data, max_error, _parts(*data, largest))
    if search.trial(Method("nothing"), "all blur").error > max_error:
        _smaller_circles(search, ways)
        _other_methods(search, ways)
        _gathered(search, largest)
    return search.plan()


class _Ways(NamedTuple):
    """What all ways to make a picture have in common: the effect, the size, the circles."""

    target: str
    shape: tuple[int, int]
    largest: float

    def effect(self, max_coc: float) -> Method:
        """The effect, with no circle larger; a part is drawn by the whole picture's kernel."""
        if self.target == "layered":
            return Method("layered", max_coc=max_coc)
        return Method("scatter", max_coc=max_coc, kernel=cheapest(*self.shape, max_coc))


def _parts(image: Any, depth: Any, lens: Any, largest: float) -> list[Part]:
    """A few tiles of a scene; none if they are not much fewer pixels.

    A blur matters by how much brightness changes, times how wide it is. Tiles in the order of
    that are split into groups that have the same sum of it: the middle tile stands for its
    group. What would reach a tile from outside is missing from its picture by the effect and by
    every other way, whose error is much the same: all about it a tile would cost several.
    """
    side = max(_SIDE, math.ceil(largest))
    rows, columns = (size // side for size in depth.shape)
    if _PARTS * side**2 > _SHARE * depth.size:
        return []
    bright = np.asarray(image).sum(axis=-1)
    change = sum(np.abs(np.diff(bright, axis=axis, append=0)) for axis in (0, 1))
    circles = np.asarray(compiled("dof", lens, depth).circle_of_confusion(depth))
    matters = np.nan_to_num(change * np.where(np.asarray(depth) > 0, circles, 0))
    matters = matters[: rows * side, : columns * side].reshape(rows, side, columns, side)
    matters = matters.sum(axis=(1, 3)).ravel() + 1e-9
    order = np.argsort(-matters)
    before = np.cumsum(matters[order]) - matters[order] / 2
    group = (_PARTS * before / matters.sum()).astype(int)
    parts = []
    for number in np.unique(group):
        members = order[group == number]
        row, column = divmod(int(members[len(members) // 2]), columns)
        window = tuple(slice(side * place, side * (place + 1)) for place in (row, column))
        share = len(members) / len(order)
        parts.append(Part((image[window], depth[window], lens), share))
    return parts


def _smaller_circles(search: Search, ways: _Ways) -> None:
    """Try the effect with ever smaller circles, halving the ladder down to the least."""
    sizes = [2.0**octave for octave in range(1, 12) if 2**octave < ways.largest]
    low, high = 0, len(sizes)
    while low < high:
        middle = (low + high) // 2
        text = f"what circles of confusion have above {sizes[middle]:g} pixels"
        error = search.trial(ways.effect(sizes[middle]), text).error
        low, high = (low, middle) if error <= search.max_error else (middle + 1, high)


def _other_methods(search: Search, ways: _Ways) -> None:
    """Try what is not the effect, but may be near it."""
    largest = ways.largest
    for split in _SPLITS:
        if split < largest:
            text = f"details of sprites wider than {split:g} pixels, at less resolution"
            octave = Method("scatter in octaves", max_coc=largest, split=split)
            # The next is nearer to the effect, and slower.
            if search.trial(octave, text).error <= search.max_error:
                break
    for name in _OTHERS:
        search.trial(Method(name, max_coc=largest), f"exact discs, by {name}")
    kernel = cheapest(*ways.shape, largest)
    if ways.target == "layered":
        exact = Method("scatter", max_coc=largest, kernel=kernel)
        search.trial(exact, "what hides what, by scatter")
        return
    search.trial(Method("layered", max_coc=largest), "the sums of all discs, by layered")
    if kernel in _KERNELS:
        other = Method("scatter", max_coc=largest, kernel=_KERNELS[kernel])
        search.trial(other, f'the kernel "{kernel}", by "{_KERNELS[kernel]}"')


def _gathered(search: Search, largest: float) -> None:
    """Try gather by some taps, by more, and by as many as should do."""

    def by(taps: int) -> Trial:
        how = Method("gather", max_coc=largest, taps=taps)
        return search.trial(how, f"exact discs, by gather of {taps} taps")

    few = by(_FEW)
    # More taps take longer still.
    if few.time > 1 or few.error <= search.max_error or (more := by(_MORE)).time > 1:
        return
    # Where both were tried, the squared error is `bias + variance / taps`.
    pairs = zip(few.squares, more.squares, strict=False)
    one, other = map(sum, zip(*pairs, strict=True))
    variance = (one - other) / (1 / _FEW - 1 / _MORE)
    room = search.max_error**2 - (other - variance / _MORE)
    if room > 0 and _MORE < variance / room <= _MOST:
        by(2 ** math.ceil(math.log2(variance / room)))
