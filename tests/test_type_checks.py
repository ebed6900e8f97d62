"""Checks that are kept refuse what new ones would."""

from collections.abc import Callable
from typing import Any, Literal

import jaxtyping
import numpy as np
import pytest
from jaxtyping import Float, Int
from type_checks import _alike, checked

Rows = Float[np.ndarray, "rows 3"]


def inner(annotation: Any, default: Any = None) -> Callable[..., object]:
    """Return a function that is defined anew at each call, with one argument."""

    def found(rows: annotation, *, default: Any = default) -> None: ...

    if default is None:

        def found(rows: annotation) -> None: ...

    return jaxtyping.jaxtyped(found, typechecker=checked)


@pytest.mark.parametrize("default", [None, 1, ()])
def test_a_function_that_is_defined_again_refuses_what_it_refused(default: object):
    for _ in range(3):
        inner(Float[np.ndarray, "rows 3"], default)(np.zeros((2, 3)))
        with pytest.raises(jaxtyping.TypeCheckError, match="rows"):
            inner(Float[np.ndarray, "rows 3"], default)(np.zeros((2, 4)))


def test_another_annotation_in_one_place_is_another_check():
    # breaks where a check is taken for that of other shapes, numbers, arrays or unions
    inner(Rows)(np.zeros((2, 3)))
    for other in (Float[np.ndarray, "rows 4"], Int[np.ndarray, "rows 3"], Float[np.memmap, "rows 3"], int | None):
        with pytest.raises(jaxtyping.TypeCheckError, match="rows"):
            inner(other)(np.zeros((2, 3)))
    inner(int | Rows)(np.zeros((2, 3)))
    inner(int | None)(None)
    with pytest.raises(jaxtyping.TypeCheckError, match="rows"):
        inner(int | Float[np.ndarray, "rows 4"])(np.zeros((2, 3)))


def test_annotations_are_alike_where_they_mean_the_same():
    for make in (
        lambda: Float[np.ndarray, "rows 3"],
        lambda: Float[np.ndarray, "rows 3"] | None,
        lambda: Callable[[Float[np.ndarray, "rows 3"], int], tuple[Int[np.ndarray, ""], ...]],
        lambda: Literal["one"],
    ):
        assert _alike(make()) == _alike(make()) and hash(_alike(make())) == hash(_alike(make()))
    assert _alike(Callable[[int], str]) != _alike(Callable[[str], int])
    assert _alike(Literal[1]) != _alike(Literal[True])


def test_a_result_is_held_to_the_sizes_of_the_arguments():
    # breaks where the arguments are not looked at before the call, or what they said is lost after it
    @jaxtyping.jaxtyped(typechecker=checked)
    def firsts(rows: Float[np.ndarray, "rows 3"], count: int) -> Float[np.ndarray, " rows"]:
        return rows[:count, 0]

    assert firsts(np.zeros((4, 3)), 4).shape == (4,)
    with pytest.raises(jaxtyping.TypeCheckError, match="the return value of"):
        firsts(np.zeros((4, 3)), 2)
    with pytest.raises(jaxtyping.TypeCheckError, match="the parameters of"):
        firsts(np.zeros((4, 2)), 4)
    with pytest.raises(jaxtyping.TypeCheckError, match="the parameters of"):
        firsts(np.zeros((4, 3)), 4.0)
