"""The registry of the cases in which methods fail: what is asked, of whom, what is found."""

import functools as ft
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple


class Found(NamedTuple):
    """The figures of one method in one case, and what it makes of it: linear, from 0 to 1."""

    figures: dict[str, float]
    picture: Any = None


class Case(NamedTuple):
    """A case: every figure is an error, 0 at best, and what it may be; None is only watched.

    A method may lack figures that it can't have.

    `gradients` says of each method whether derivatives are exact in this case, zero, biased,
    missing or none, and why.
    """

    effect: str
    name: str
    says: str
    asks: dict[str, float | None]
    gradients: dict[str, str]
    find: Callable[[str], Found]
    needs: str = ""

    def passes(self, figures: Mapping[str, float]) -> bool:
        """Whether all figures are what is asked."""
        bounds = {name: self.asks[name] for name in figures}
        return all(
            figures[name] <= bound for name, bound in bounds.items() if bound is not None
        )


CASES: list[Case] = []


def case(
    effect: str,
    asks: dict[str, float | None],
    methods: Iterable[str],
    gradients: dict[str, str] | str = "exact",
    *,
    needs: str = "",
) -> Callable[[Callable[[str], Found]], Callable[[str], Found]]:
    """Enter a function of a method's name in the registry, under its own name and docstring.

    `gradients` are for all methods, or for those that have them; others' are exact. `needs`
    is a module that a user may not have.
    """
    if isinstance(gradients, str):
        gradients = dict.fromkeys(methods, gradients)
    said = {method: gradients.get(method, "exact") for method in methods}

    def enter(find):
        found = ft.cache(find)
        name, says = find.__name__.replace("_", " "), " ".join((find.__doc__ or "").split())
        CASES.append(Case(effect, name, says, asks, said, found, needs))
        return found

    return enter


def not_measured(effect: str, name: str, why: str) -> None:
    """Enter a case that has no figure, with the reason."""
    CASES.append(Case(effect, name, why, {}, {}, lambda method: Found({})))
