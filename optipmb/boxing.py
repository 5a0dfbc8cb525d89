"""How the arrays of a kernel become those of numpy: as numba has it, without a call of Python for each of them.

numba finds the class `numpy.ndarray` again for every array that a kernel returns, in an interpreted function. A step
that returned fifty arrays spent a tenth of its time there; it returns twenty. Here the class is a constant of the
kernel, as the type of the numbers is in numba too. numba has no public way to replace one of its own conversions. Where
a version lacks what is used here, its conversion stays, which makes the same arrays.
"""

from __future__ import annotations

from typing import Any, Final

from llvmlite import ir
from numba.core import boxing, cgutils, pythonapi, types
from numba.np import numpy_support

_ir: Final[Any] = ir  # their type information is partial
_cgutils: Final[Any] = cgutils


def _array(kind: Any, value: Any, context: Any) -> Any:
    """Emit the code that returns a native array of a numba type as one of numpy, to which its memory then belongs."""
    api, builder, constants = context.pyapi, context.builder, context.env_manager
    dtype = constants.read_const(constants.add_const(numpy_support.as_dtype(kind.dtype)))
    array_class = constants.read_const(constants.add_const(kind.box_type))
    number = _ir.IntType(32)
    signature = _ir.FunctionType(api.pyobj, [api.voidptr, api.pyobj, number, number, api.pyobj])
    adapt = _cgutils.get_or_insert_function(api.module, signature, "NRT_adapt_ndarray_to_python_acqref")
    native = builder.bitcast(_cgutils.alloca_once_value(builder, value), api.voidptr)
    made = builder.call(adapt, [native, array_class, number(kind.ndim), number(int(kind.mutable)), dtype])
    context.context.nrt.decref(builder, kind, value)  # the array has a reference of its own
    return made


def use_constant_class() -> None:
    """Have the kernels that are compiled from now on return their arrays in this way."""
    conversions: Any = getattr(pythonapi, "_boxers", None)
    theirs = getattr(boxing, "box_array", None)
    if conversions is not None and theirs is not None and conversions.functions.get(types.Array) is theirs:
        conversions.functions[types.Array] = _array
