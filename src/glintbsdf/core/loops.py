"""Loops that sum, branches inside of them, and their derivatives.

A differentiable loop of Dr.Jit (1.5), ``dr.while_loop(…, max_iterations=-1)``, propagates the
derivatives of its state and of arrays in memory that its body gathers from. But the body may also
capture values that are not part of the state, and that were computed in a recorded call. In a BSDF
inside of an integrator's loop, all values are. Dr.Jit silently drops their derivatives. So
:func:`symbolic_loop` finds the captured values itself, and makes them part of the state.

And Dr.Jit calls the body again when it differentiates backwards. By then, the function around it
may have given its variables other values. So the loop keeps those that they had.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from functools import cache, partial
from types import CellType, FunctionType, MethodType, ModuleType
from typing import Any

import drjit as dr
import mitsuba as mi


def symbolic_loop(state: tuple, condition: Callable, body: Callable, label: str) -> tuple:
    """Run a loop as part of a kernel: while ``condition(*state)`` holds, ``state = body(*state)``.

    It is differentiable in both modes if the body only adds to the state variables that carry
    derivatives, or does not change them. Any other loop belongs in a block of ``dr.suspend_grad``.
    The body may use any values of the functions around it, and may contain further loops.

    Args:
        state: tuple of Dr.Jit arrays, or containers of them.
        condition: function of the state that returns an ``mi.Bool``.
        body: function of the state that returns the new state.
        label: name of the loop in Dr.Jit's messages.

    Returns:
        The final state, a tuple like ``state``.
    """
    condition, body = frozen(condition, {}), frozen(body, {})
    captured = Captured(body)
    width, count = dr.width((*state, *captured.values)), len(state)
    # All values get one width: in nested loops, Dr.Jit cannot sum the derivatives of a narrower
    # one.
    values = [value + dr.zeros(type(value), width) for value in captured.values]

    def body_with_values(*state):
        state, values = state[:count], state[count:]
        return *captured.function_with(values)(*state), *values

    # The mode is explicit: Mitsuba switches symbolic loops off when it differentiates, and Dr.Jit
    # then warns of every loop in a call.
    return dr.while_loop(
        (*state, *values),
        lambda *state: condition(*state[:count]),
        body_with_values if values else body,
        mode="symbolic",
        max_iterations=-1,
        label=label,
    )[:count]


def frozen(thing: Any, done: dict) -> Any:
    """A copy of a function whose enclosing variables keep the values that they have now.

    So do those of the functions that it refers to. Anything but a function is returned as it is.
    ``done`` maps the identity of each function met so far to its copy.
    """
    if type(thing) is partial:
        return partial(frozen(thing.func, done), *thing.args, **thing.keywords)
    if type(thing) is not FunctionType or not thing.__closure__:
        return thing
    if id(thing) not in done:
        cells = tuple(CellType() for _ in thing.__closure__)
        done[id(thing)] = function_with_cells(thing, thing.__defaults__, cells)
        for cell, former in zip(cells, thing.__closure__, strict=True):
            if is_set(former):
                cell.cell_contents = frozen(former.cell_contents, done)
    return done[id(thing)]


def derivatives_exist() -> bool:
    """Whether any array has derivatives that are recorded here. Otherwise no search for them is
    needed, which takes a fourth of the time to record a kernel."""
    fresh = mi.Float(0)
    dr.enable_grad(fresh)
    if not dr.grad_enabled(fresh):
        return False  # within a block of dr.suspend_grad
    if fresh.index_ad > 1:
        return True  # Dr.Jit (1.5) takes the smallest number that is free, and counts from 1
    del fresh
    table = dr.whos_ad(True)  # titles between lines, and a line for each variable
    return table is None or len(table.split()) > EMPTY_TABLE


#: Words of the table when no array has derivatives: five titles of columns, and two lines.
EMPTY_TABLE = 7


class Captured:
    """The arrays with derivatives that a function captures.

    They are searched in the variables of enclosing functions, in the objects and functions that
    these refer to, and so on. Evaluated arrays, which are in memory, are left out: Dr.Jit keeps
    their derivatives, and arrays to gather from have sizes of their own.

    Attributes:
        values (list): the arrays.
    """

    def __init__(self, function: Callable) -> None:
        self.function = function
        self.values: list = []
        self.places: dict[tuple[int, int], int] = {}

        def is_captured(array) -> bool:
            if array.state == dr.VarState.Evaluated or not dr.grad_enabled(array):
                return False
            if identity(array) not in self.places:
                self.places[identity(array)] = len(self.values)
                self.values.append(array)
            return True

        self.holders = holders_of(function, is_captured) if derivatives_exist() else {}

    def function_with(self, values) -> Callable:
        """A copy of the function that uses ``values`` in place of the captured arrays."""
        return self.replaced(self.function, values, {})

    def replaced(self, thing: Any, values, done: dict[int, tuple[object, object]]) -> Any:
        """``thing`` with ``values`` in place of the arrays in it; itself if it holds none. ``done``
        has the objects met so far, and their replacements, by identity."""
        way = way_into(thing.__class__)
        if way is into_array:
            place = self.places.get(identity(thing))
            return thing if place is None else values[place]
        if way is None or (id(thing) not in self.holders and way not in MAKE_PARTS):
            return thing
        if id(thing) not in done:
            # While an object is alive, no other gets its identity.
            done[id(thing)] = thing, thing
            parts, remade = way(thing)
            new = [self.replaced(part, values, done) for part in parts]
            if any(a is not b for a, b in zip(new, parts, strict=True)):
                done[id(thing)] = thing, remade(new)
        return done[id(thing)][1]


def identity(array) -> tuple[int, int]:
    """A key that is equal for arrays that are the same variable with the same derivatives."""
    return array.index, array.index_ad


# ------------------------------------------------------------------------------------------------
#  Traversal of everything that a function refers to
# ------------------------------------------------------------------------------------------------


def arrays_in(thing: Any) -> list:
    """All arrays of one dimension that a thing refers to."""
    arrays: list = []

    def add(array) -> bool:
        arrays.append(array)
        return True

    holders_of(thing, add)
    return arrays


def holders_of(thing: Any, is_wanted: Callable[[Any], bool]) -> dict[int, object]:
    """All objects that are or hold a wanted array, by identity.

    It looks into containers, functions and their enclosing variables, objects and their attributes.
    The objects are kept alive, so that no other object gets the identity of one of them.
    """
    holders: dict[int, object] = {}
    holds(thing, is_wanted, {}, holders)
    return holders


def holds(thing: Any, is_wanted: Callable[[Any], bool], met: dict, holders: dict) -> bool:
    """Whether ``thing`` is or holds a wanted array; then it is added to ``holders``, as everything
    inside of it that does. ``met`` has the objects met so far, by identity.

    This is no function within another one: that would refer to itself, and keep all arrays alive.
    """
    if id(thing) in met:
        return id(thing) in holders
    met[id(thing)] = thing
    way = way_into(thing.__class__)
    if way is None:
        return False
    if way is into_array:
        found = is_wanted(thing)
    else:
        found = any([holds(part, is_wanted, met, holders) for part in way(thing)[0]])
    if found:
        holders[id(thing)] = thing
    return found


@cache
def way_into(kind: type) -> Callable | None:
    """How to look into objects of a type: a function that returns an object's parts, and a function
    that makes a copy of it with other parts; None for what has no parts."""
    if dr.is_array_v(kind):
        if dr.is_tensor_v(kind):
            return None
        return into_array if dr.depth_v(kind) == 1 else into_vector
    if issubclass(kind, tuple | list):
        return into_list
    if getattr(kind, "DRJIT_STRUCT", None) and not issubclass(kind, type):
        return into_struct  # Mitsuba's interactions, for example
    return WAYS.get(kind) or (into_object if keeps_attributes(kind) else None)


def into_array(array: Any) -> tuple[list, Callable]:
    """Arrays of one dimension have no parts; they are what is searched."""
    return [], lambda new: array


def into_vector(vector: Any) -> tuple[list, Callable]:
    kind = type(vector)
    return list(vector), lambda new: with_items(kind(vector), enumerate(new))


def into_list(values: tuple | list) -> tuple[list, Callable]:
    return list(values), getattr(type(values), "_make", type(values))


def into_dict(table: dict) -> tuple[list, Callable]:
    return list(table.values()), lambda new: dict(zip(table, new, strict=True))


def into_method(method: MethodType) -> tuple[list, Callable]:
    return [method.__self__], lambda new: MethodType(method.__func__, *new)


def into_partial(thing: partial) -> tuple[list, Callable]:
    return [thing.func, thing.args, thing.keywords], lambda new: partial(new[0], *new[1], **new[2])


def into_struct(thing: Any) -> tuple[list, Callable]:
    kind = type(thing)
    names = list(kind.DRJIT_STRUCT)
    return [getattr(thing, name) for name in names], lambda new: with_attributes(
        kind(thing), zip(names, new, strict=True)
    )


def into_object(thing: Any) -> tuple[list, Callable]:
    names = list(vars(thing))
    return list(vars(thing).values()), lambda new: with_attributes(
        copy(thing), zip(names, new, strict=True)
    )


def into_function(function: FunctionType) -> tuple[list, Callable]:
    """The default arguments and enclosing variables of a function; see :func:`way_into`."""
    cells = [cell for cell in function.__closure__ or () if is_set(cell)]

    def remade(new):
        defaults, *contents = new
        cell_of = {id(cell): CellType(part) for cell, part in zip(cells, contents, strict=True)}
        closure = tuple(cell_of.get(id(cell), cell) for cell in function.__closure__ or ())
        return function_with_cells(function, defaults, closure)

    return [function.__defaults__, *(cell.cell_contents for cell in cells)], remade


def function_with_cells(
    function: FunctionType, defaults: tuple | None, closure: tuple
) -> FunctionType:
    """A copy of a function with these default arguments and cells of enclosing variables."""
    result = FunctionType(
        function.__code__, function.__globals__, function.__name__, defaults, closure
    )
    result.__kwdefaults__ = function.__kwdefaults__
    return result


def is_set(cell: CellType) -> bool:
    """Whether an enclosing variable has a value yet."""
    try:
        cell.cell_contents  # noqa: B018
    except ValueError:
        return False
    return True


def keeps_attributes(kind: type) -> bool:
    """Whether the whole state of objects of a type is in their Python attributes. This is not so
    for plugins of Mitsuba, which have a part in C++, nor for classes and modules."""
    return (
        kind.__dictoffset__ != 0
        and not issubclass(kind, type | ModuleType)
        and not any(base.__module__.startswith("mitsuba") for base in kind.__mro__)
    )


def with_items(thing, items):
    """Set these items of ``thing``, and return it."""
    for key, value in items:
        thing[key] = value
    return thing


def with_attributes(thing, attributes):
    """Set these attributes of ``thing``, and return it."""
    for name, value in attributes:
        object.__setattr__(thing, name, value)
    return thing


#: The ways that make an object's parts anew with each look.
MAKE_PARTS = into_vector, into_struct

#: How to look into objects of these types; see :func:`way_into`.
WAYS: dict[type, Callable] = {
    dict: into_dict,
    MethodType: into_method,
    partial: into_partial,
    FunctionType: into_function,
}


def add_where(density, condition, added, active):
    """``density + added()`` in the lanes where the condition holds, by a branch."""
    return where_needed(active & condition, lambda total: (total + added(),), (density,))[0]


def where_needed(needed, added, sums: tuple) -> tuple:
    """``added(*sums)`` in the lanes that need it, and ``sums`` in all others; by a branch.

    ``added`` only adds to the sums. In loops, Dr.Jit (1.5) cannot record derivatives through a
    branch, but it can through an inner loop whose sums begin with zero. So the branch is a loop of
    one turn where derivatives are recorded.
    """
    if not derivatives_exist():
        return dr.if_stmt(sums, needed, added, lambda *sums: sums)

    def once(needed, *sums):
        return needed & False, *added(*sums)

    state = (mi.Bool(needed), *(dr.zeros(type(total)) for total in sums))
    found = symbolic_loop(state, lambda needed, *_: needed, once, "branch")[1:]
    return tuple(a + b for a, b in zip(sums, found, strict=True))
