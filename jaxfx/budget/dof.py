"""Depth of field within an error."""

import math
from typing import Any, Literal, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Num

from jaxfx._arguments import check_lens
from jaxfx._arrays import ArrayLike
from jaxfx._checks import Number, check_depth, check_image, option
from jaxfx.budget._octaves import octaves
from jaxfx.budget._search import Part, Search, Trial, check_call, plan
from jaxfx.budget.plan import Plan
from jaxfx.dof.arguments import check_arguments, compiled, largest_coc, largest_of
from jaxfx.dof.blend import blend
from jaxfx.dof.diffusion import implicit_diffusion
from jaxfx.dof.gather import gather
from jaxfx.dof.layered import layered
from jaxfx.dof.scatter import cheapest, scatter
from jaxfx.dof.separable import separable
from jaxfx.lens import Lens


# The circles of confusion in pixels from which on sprites are tried at lower resolutions. Below
# three times epsilon, 6 pixels, the leak rejection is not a factor of the target pixel.
_SPLITS = (8.0, 10.0)

# The numbers of gather's taps that are tried, from whose errors follows how many would do; and
# the largest number that is tried then.
_FEW, _MORE, _MOST = 4, 16, 64

# The parts on which candidates are tried: their number, their side in pixels (at least the
# largest circle of confusion), and the largest part of the image that they may be, a ratio;
# beyond it the whole image is used. More or larger parts predict better and take longer.
_PARTS, _SIDE, _SHARE = 6, 64, 1 / 4


def _nothing(image: Any, depth: Any, lens: Any) -> Any:
    """The image as it is."""
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
# The other program of scatter that is tried beside the one it would take.
_PROGRAMS = {"tiles": "spans", "spans": "tiles"}
# The methods that are tried with their defaults.
_OTHERS = ("separable", "implicit diffusion", "blend")


class Method(eqx.Module):
    """A method of depth of field and its options."""

    name: str = eqx.field(static=True)
    options: tuple[tuple[str, Any], ...] = eqx.field(static=True)

    def __init__(self, name: str, **options: Any):
        self.name, self.options = name, tuple(options.items())

    @property
    def title(self) -> str:
        """Its name, for a plan that is printed."""
        return f"depth of field by {self.name}"

    def __call__(self, image: Any, depth: Any, lens: Any) -> Any:
        """The image by this method."""
        return _METHODS[self.name](image, depth, lens, **dict(self.options))


def dof(
    image: Float[ArrayLike, "height width channel"],
    depth: Num[ArrayLike, "height width"],
    lens: Lens,
    *,
    max_error: Number,
    effect: Literal["scatter", "layered"] = "scatter",
) -> Plan:
    """The quickest depth of field within an error of `dof.scatter` or `dof.layered`.

    For a scene that is drawn again and again. The plan is called with image, depth and lens.

    **Arguments:**

    - `image`: height width channel, linear radiance.
    - `depth`: height width, scene units along the optical axis, inf for background; 0, negative
      or NaN where it is missing.
    - `lens`: gives each depth its signed defocus, in pixels.
    - `max_error`: root mean square, linear image units, over all pixels and channels.
    - `effect`: the effect to replace: `dof.scatter` with `gamma=0`, `epsilon=2` and exact
      programs, or `dof.layered`, from one image.

    **Returns:** a `Plan`, to be called with `image, depth, lens`, of this scene or of others
    with no larger circles: those are drawn as large as this scene's largest.

    **Raises:** `ValueError` for a wrong shape, a negative `max_error`, an unknown `effect` or
    traced data.

    **Gradient:** none through the choice; the plan's image has that of what it draws.

    **Example:** where all is in focus, nothing is done.

    >>> import numpy as np
    >>> from jaxfx import ThinLens, budget
    >>> image, depth = np.ones((8, 8, 3), np.float32), np.full((8, 8), 2.0, np.float32)
    >>> print(budget.dof(image, depth, ThinLens(0.1, 2.0, 8.0), max_error=0.01).recipe.title)
    depth of field by nothing

    Where no circle of confusion is wider than a pixel, nothing is done, and nothing tried.
    Otherwise the effect and cheaper candidates are drawn on six tiles of this scene, which
    stand for as many groups of tiles that a blur changes alike, or on all of it where it is
    small. The candidates: the image as it is; circles no larger than a power of two (the
    smallest that will do is searched by halving); sprites wider than 8 or 10 pixels in octaves,
    the larger at the lower resolution; another program of scatter; the separable filter,
    diffusion, blending, layers; and gather, with the number of taps that its variance asks
    for: from the errors of two numbers of taps follow the part that more taps can lower and
    the part that they can't. A candidate is dropped at the tile at which it errs too much or is
    too slow. Of the others the quickest is measured on the whole scene and, if its error holds
    there, taken; or else one that errs less, and at the last the effect itself. The effect goes
    no farther in each tile than the largest circle that reaches it.

    It costs one rendering for the proof, one by the plan (two or three if the tiles misled),
    and about as much as another for the tiles; at first also a program for each candidate.
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
    shared = _Candidates(effect, (depth.shape[0], depth.shape[1]), largest)
    data = (image, depth, lens)
    search = Search(shared.drawn(largest), data, max_error, _parts(*data, largest))
    if search.trial(Method("nothing"), "all blur").error > max_error:
        _smaller_circles(search, shared)
        _other_methods(search, shared)
        _gathered(search, largest)
    return search.plan()


class _Candidates(NamedTuple):
    """What all candidates have in common.

    - `effect`: its name.
    - `shape`: height and width of the image, in pixels.
    - `largest`: the largest circle of confusion, in pixels.
    """

    effect: str
    shape: tuple[int, int]
    largest: float

    def drawn(self, max_coc: float) -> Method:
        """The effect, with no circle larger than `max_coc`; by the whole image's program."""
        if self.effect == "layered":
            return Method("layered", max_coc=max_coc)
        return Method("scatter", max_coc=max_coc, program=cheapest(*self.shape, max_coc))


def _parts(image: Any, depth: Any, lens: Any, largest: float) -> list[Part]:
    """A few tiles of a scene; none if they are more than `_SHARE` of it.

    A blur changes a tile by about the change of brightness between its pixels times their
    circles of confusion. Tiles in the order of that are split into groups of equal sums; the
    middle tile of a group stands for it. What would reach a tile from outside is missing from
    its image by the effect and by every candidate alike: to draw the surroundings too would
    cost several tiles.
    """
    side = max(_SIDE, math.ceil(largest))
    rows, columns = (size // side for size in depth.shape)
    if _PARTS * side**2 > _SHARE * depth.size:
        return []
    bright = np.asarray(image).sum(axis=-1)
    change = sum(np.abs(np.diff(bright, axis=axis, append=0)) for axis in (0, 1))
    circles = np.asarray(compiled("dof", lens, depth).circle_of_confusion(depth))
    blurred = np.nan_to_num(change * np.where(np.asarray(depth) > 0, circles, 0))
    blurred = blurred[: rows * side, : columns * side].reshape(rows, side, columns, side)
    blurred = blurred.sum(axis=(1, 3)).ravel() + 1e-9
    order = np.argsort(-blurred)
    before = np.cumsum(blurred[order]) - blurred[order] / 2
    group = (_PARTS * before / blurred.sum()).astype(int)
    parts = []
    for number in np.unique(group):
        members = order[group == number]
        row, column = divmod(int(members[len(members) // 2]), columns)
        window = tuple(slice(side * place, side * (place + 1)) for place in (row, column))
        share = len(members) / len(order)
        parts.append(Part((image[window], depth[window], lens), share))
    return parts


def _smaller_circles(search: Search, shared: _Candidates) -> None:
    """Try the effect with ever smaller circles, halving the ladder down to the least."""
    sizes = [2.0**octave for octave in range(1, 12) if 2**octave < shared.largest]
    low, high = 0, len(sizes)
    while low < high:
        middle = (low + high) // 2
        text = f"what circles of confusion have above {sizes[middle]:g} pixels"
        error = search.trial(shared.drawn(sizes[middle]), text).error
        low, high = (low, middle) if error <= search.max_error else (middle + 1, high)


def _other_methods(search: Search, shared: _Candidates) -> None:
    """Try octaves, other methods and the other program."""
    largest = shared.largest
    for split in _SPLITS:
        if split < largest:
            text = f"details of sprites wider than {split:g} pixels, at less resolution"
            octave = Method("scatter in octaves", max_coc=largest, split=split)
            # The next is nearer to the effect, and slower.
            if search.trial(octave, text).error <= search.max_error:
                break
    for name in _OTHERS:
        search.trial(Method(name, max_coc=largest), f"exact discs, by {name}")
    program = cheapest(*shared.shape, largest)
    if shared.effect == "layered":
        exact = Method("scatter", max_coc=largest, program=program)
        search.trial(exact, "what hides what, by scatter")
        return
    search.trial(Method("layered", max_coc=largest), "the sums of all discs, by layered")
    if program in _PROGRAMS:
        other = Method("scatter", max_coc=largest, program=_PROGRAMS[program])
        search.trial(other, f'the program "{program}", by "{_PROGRAMS[program]}"')


def _gathered(search: Search, largest: float) -> None:
    """Try gather with few taps, with more, and with the number that its variance asks for."""

    def gathered(taps: int) -> Trial:
        candidate = Method("gather", max_coc=largest, taps=taps)
        return search.trial(candidate, f"exact discs, by gather of {taps} taps")

    few = gathered(_FEW)
    # More taps take longer still.
    if few.time > 1 or few.error <= search.max_error or (more := gathered(_MORE)).time > 1:
        return
    # On the parts where both were drawn, the squared error is `bias + variance / taps`.
    pairs = zip(few.squares, more.squares, strict=False)
    few_square, more_square = map(sum, zip(*pairs, strict=True))
    variance = (few_square - more_square) / (1 / _FEW - 1 / _MORE)
    allowed_variance = search.max_error**2 - (more_square - variance / _MORE)
    if allowed_variance > 0 and _MORE < variance / allowed_variance <= _MOST:
        gathered(2 ** math.ceil(math.log2(variance / allowed_variance)))
