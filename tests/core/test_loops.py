"""Loops keep the derivatives of captured values, wherever they run."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf.core.loops import Captured, add_where, symbolic_loop

TURNS = 5


def count_and_add(term, zero):
    """Σ term(k) over k = 0 … TURNS − 1, starting with ``zero``."""

    def body(k, total):
        return k + 1, total + term(mi.Float(k))

    return symbolic_loop((mi.UInt32(0), zero), lambda k, _: k < TURNS, body, "sum")[1]


def by_variable(x):
    y = x * x
    return count_and_add(lambda k: k * y, mi.Float(0))


def by_vector(x):
    y = mi.Vector2f(x * x, 1)
    return count_and_add(lambda k: k * y, mi.Vector2f(0)).x


def by_object(x):
    kernel = SimpleNamespace(scales=[x * x], name="kernel")
    return count_and_add(lambda k: k * kernel.scales[0], mi.Float(0))


def by_method(x):
    class Kernel:
        def value(self, k):
            return k * self.scale

    kernel = Kernel()
    kernel.scale = x * x
    return count_and_add(kernel.value, mi.Float(0))


def by_interaction(x):
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.uv = mi.Point2f(0, x * x)
    return count_and_add(lambda k: k * si.uv.y, mi.Float(0))


def by_matrix(x):
    y = mi.Matrix2f(1, x * x, 2, 3)
    return count_and_add(lambda k: k * (y @ mi.Vector2f(0, 1)).x, mi.Float(0))


def by_partial(x):
    return count_and_add(partial(lambda y, k: k * y, x * x), mi.Float(0))


def by_default(x):
    return count_and_add(lambda k, y=x * x: k * y, mi.Float(0))


def by_function(x):
    y = x * x

    def scaled(k):
        return k * y

    return count_and_add(lambda k: scaled(k), mi.Float(0))


def by_nested_loop(x):
    """Σ_j Σ_k (j + k) x² / TURNS, minus its excess over Σ k x²."""
    y = x * x

    def inner(j):
        return count_and_add(lambda k: (k + j) * y, mi.Float(0)) / TURNS

    return count_and_add(inner, mi.Float(0)) - sum(range(TURNS)) * y


def by_branches(x):
    """Σ k x² over the turns of two branches; one of them is inside of another."""
    y = x * x

    def even(k):
        return add_where(k * y, dr.square(k) > 9, lambda: (k - 3) * y, True)

    def term(k):
        is_even = (mi.UInt32(k) & 1) == 0
        total = add_where(mi.Float(0), is_even, lambda: even(k), True)
        return add_where(total, ~is_even, lambda: k * y, True)

    return count_and_add(term, mi.Float(0)) - (TURNS - 1 - 3) * y


FORMS = [by_variable, by_vector, by_matrix, by_object, by_method, by_interaction, by_partial,
         by_default, by_function, by_nested_loop, by_branches]  # fmt: skip
FACTOR = sum(range(TURNS))


def in_a_call(function, x):
    """The function in a recorded call in a recorded loop, like a BSDF in an integrator."""

    def body(n, total):
        index = mi.UInt32(dr.opaque(mi.UInt32, 0))
        return n + 1, total + dr.switch(index, [function, lambda x: x], x * 1.5)

    state = mi.UInt32(0), mi.Float(0)
    return dr.while_loop(state, lambda n, _: n < 2, body, max_iterations=-1)[1]


@pytest.mark.parametrize("mode", ["forward", "reverse"])
@pytest.mark.parametrize("function", FORMS)
def test_derivative_of_what_is_captured(variant, function, mode):
    x = dr.opaque(mi.Float, 0.7)
    dr.enable_grad(x)
    y = in_a_call(function, x)
    if mode == "forward":
        dr.forward(x)
        derivative = dr.grad(y)
    else:
        dr.backward(y)
        derivative = dr.grad(x)
    assert dr.allclose(y, 2 * FACTOR * (1.5 * 0.7) ** 2)
    assert dr.allclose(derivative, 2 * FACTOR * 2 * 1.5**2 * 0.7)


@pytest.mark.parametrize("nested", [False, True])
def test_variables_may_be_given_other_values_afterwards(variant, nested):
    """Dr.Jit calls the body again, later, for derivatives."""
    x = mi.Float(0.7, 0.8)
    dr.enable_grad(x)
    factor, turns = mi.Float(3), mi.UInt32(TURNS)

    def term():
        return factor * dr.square(x)

    def body(k, total):
        return k + 1, total + (term() if nested else factor * dr.square(x))

    _, total = symbolic_loop(
        (mi.UInt32(0), mi.Float(0)), lambda k, _: k < turns, body, "a factor that changes"
    )
    factor, turns = dr.rcp(total), turns - 1
    dr.backward(total, flags=dr.ADFlag.ClearInterior)
    assert dr.allclose(dr.grad(x), 6 * TURNS * x)


@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_narrow_values_in_nested_loops(variant, mode):
    """Three lanes, with a derivative with respect to a value that they share."""
    x = mi.Float(0.7)
    dr.enable_grad(x)
    y = by_nested_loop(x) * mi.Float(1, 2, 3)
    common = dr.square(x)
    y = y + count_and_add(lambda j: count_and_add(lambda k: common, mi.Float(0, 0, 0)), mi.Float(0))
    expected = 2 * 0.7 * (FACTOR * np.array([1, 2, 3]) + TURNS**2)
    if mode == "forward":
        dr.forward(x)
        assert dr.allclose(dr.grad(y), expected)
    else:
        dr.backward(dr.sum(y))
        assert dr.allclose(dr.grad(x), expected.sum())


@pytest.mark.parametrize("function", FORMS)
def test_value_without_derivatives(variant, function):
    assert dr.allclose(function(mi.Float(0.7)), FACTOR * 0.49)


def test_arrays_in_memory_stay_where_they_are(variant):
    """Arrays to gather from may have any size."""
    table = mi.Float([1, 2, 3, 4, 5])
    dr.enable_grad(table)
    total = count_and_add(lambda k: dr.gather(mi.Float, table, mi.UInt32(k)), mi.Float(0))
    dr.backward(total)
    assert dr.allclose(total, 15) and dr.allclose(dr.grad(table), 1)
    assert Captured(lambda: table).values == []


def test_nothing_is_moved_without_derivatives(variant):
    y = mi.Float(2) * 3
    function = lambda: y  # noqa: E731
    captured = Captured(function)
    assert captured.values == [] and captured.function_with([]) is function


def test_a_function_that_refers_to_itself(variant):
    x = mi.Float(2)
    dr.enable_grad(x)
    y = x * x

    def term(k, again=True):
        return term(k, False) if again else k * y

    assert len(Captured(term).values) == 1
