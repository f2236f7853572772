"""One layer of all chains in compiled code: `native/layers.cpp`, which `layers.py` calls where it can.

The same arithmetic as in PyTorch, several times faster on a CPU: what lies between two products stays in the cache,
products with triangular matrices leave the zeros out, and results differ by the rounding of double precision alone.
Chains do not meet, so each thread takes its share of them.
"""

import ctypes
from collections.abc import Callable
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc import compiler
from gym_dgpmpc.gp.kernels import Kernel

SOURCE = "inference/native/layers.cpp"

_Doubles = ctypes.c_void_p
_Count = ctypes.c_int64


class _Layer(ctypes.Structure):
    _fields_ = (
        ("kernel", _Count),
        ("num_inducing", _Count),
        ("input_size", _Count),
        ("lengthscale", _Doubles),
        ("variance", _Doubles),
        ("centres", _Doubles),
        ("inverse", _Doubles),
        ("own_slope", _Doubles),
    )


class _Points(ctypes.Structure):
    _fields_ = (
        ("count", _Count),
        ("outputs", _Count),
        ("whitened", _Doubles),
        ("scaled", _Doubles),
        ("projected", _Doubles),
        ("slope", _Doubles),
        ("mean_bar", _Doubles),
        ("variance_bar", _Doubles),
        ("whitened_bar", _Doubles),
        ("scaled_bar", _Doubles),
        ("centres_bar", _Doubles),
    )


_ARGUMENTS = {
    "own_correlations": (_Doubles, _Doubles),
    "invert": (_Doubles, _Doubles),
    "see": (_Count, _Doubles, _Count, _Doubles, _Doubles, _Doubles),
    "moments": (_Count, _Doubles, _Count, _Doubles, ctypes.c_double, _Doubles, _Doubles),
    "back": (ctypes.POINTER(_Points),),
    "gram": (_Count, _Doubles, _Count, _Doubles, _Doubles),
}
"""Of each function, between the layer and the range of chains."""


def can_take(kernel: Kernel, like: Tensor) -> bool:
    """Whether there is compiled code for this machine, this kernel, and tensors of this kind; builds it at first.

    Warns once if there is, but without the kernel.
    """
    if like.device.type != "cpu" or like.dtype != torch.float64 or _library() is None:
        return False
    if _kernel_number(kernel) is not None:
        return True
    compiler.warn_once(f"there is no kernel {kernel.name!r} in {SOURCE}")
    return False


class CompiledLayer:
    """A layer whose kernel `can_take` knows.

    Args:
        kernel: of all chains.
        lengthscale, variance: of each.
        centres: inducing inputs over the lengthscales.

    Raises:
        MemoryError: by every method, where a few hundred kilobytes per thread could not be allocated.
    """

    def __init__(
        self,
        kernel: Kernel,
        lengthscale: Float[Tensor, "C D"],
        variance: Float[Tensor, "C"],
        centres: Float[Tensor, "C M D"],
    ):
        self._chains, self._size, self._inputs = centres.shape
        self._kept_alive = [tensor.contiguous() for tensor in (lengthscale, variance, centres)]
        pointers = (tensor.data_ptr() for tensor in self._kept_alive)
        self._layer = _Layer(_kernel_number(kernel), self._size, self._inputs, *pointers)

    def own_correlations(self) -> tuple[Float[Tensor, "C M M"], Float[Tensor, "C M M"]]:
        """r(Z, Z) and its slopes; they are kept for `back`."""
        value, slope = (self._new(self._size, self._size) for _ in range(2))
        self._call("own_correlations", value.data_ptr(), slope.data_ptr())
        self._kept_alive.append(slope)
        self._layer.own_slope = slope.data_ptr()
        return value, slope

    def invert(self, factor: Float[Tensor, "C M M"]) -> Float[Tensor, "C M M"]:
        """L^-1 of lower triangular matrices; it is kept for all that follows."""
        by_column, inverse = factor.mT.contiguous(), self._new(self._size, self._size)
        self._call("invert", by_column.data_ptr(), inverse.data_ptr())
        self._kept_alive.append(inverse)
        self._layer.inverse = inverse.data_ptr()
        return inverse

    def see(
        self, x: Float[Tensor, "C n D"]
    ) -> tuple[Float[Tensor, "C n D"], Float[Tensor, "C M n"], Float[Tensor, "C n M"]]:
        """The fields of `layers.Seen`."""
        x = x if x.stride()[1:] == (self._inputs, 1) else x.contiguous()  # chains that see the same need no copies
        num_points = x.shape[1]
        scaled, projected, slope = (self._new(num_points, size) for size in (self._inputs, self._size, self._size))
        pointers = (tensor.data_ptr() for tensor in (scaled, projected, slope))
        self._call("see", num_points, x.data_ptr(), x.stride(0), *pointers)
        return scaled, projected.mT, slope

    def moments(
        self, whitened: Float[Tensor, "C M O"], projected: Float[Tensor, "C M n"], least: float
    ) -> tuple[Float[Tensor, "C n O"], Float[Tensor, "C n"]]:
        """Mean and variance of `layers.Passed`."""
        whitened, by_point = whitened.contiguous(), projected.mT.contiguous()
        num_points, outputs = by_point.shape[1], whitened.shape[2]
        mean, variance = self._new(num_points, outputs), self._new(num_points)
        self._call(
            "moments", outputs, whitened.data_ptr(), num_points, by_point.data_ptr(), least, mean.data_ptr(),
            variance.data_ptr(),
        )  # fmt: skip
        return mean, variance

    def back(
        self,
        whitened: Float[Tensor, "C M O"],
        seen: tuple[Float[Tensor, "C n D"], Float[Tensor, "C M n"], Float[Tensor, "C n M"]],
        mean_bar: Float[Tensor, "C n O"],
        variance_bar: Float[Tensor, "C n"],
        *,
        of_points: bool,
        of_centres: bool,
    ) -> tuple[Float[Tensor, "C M O"], Float[Tensor, "C n D"] | None, Float[Tensor, "C M D"] | None]:
        """The fields of `layers.LayerGradients`; those of the points come with those of the centres."""
        scaled, projected, slope = seen
        given = [t.contiguous() for t in (whitened, scaled, projected.mT, slope, mean_bar, variance_bar)]
        num_points, outputs = mean_bar.shape[1:]
        whitened_bar = self._new(self._size, outputs)
        scaled_bar = self._new(num_points, self._inputs) if of_points or of_centres else None
        centres_bar = self._new(self._size, self._inputs) if of_centres else None
        found = whitened_bar, scaled_bar, centres_bar
        pointers = (None if tensor is None else tensor.data_ptr() for tensor in (*given, *found))
        self._call("back", ctypes.byref(_Points(num_points, outputs, *pointers)))
        return found

    def gram(self, projected: Float[Tensor, "C M n"], weights: Float[Tensor, "C T n"]) -> Float[Tensor, "C T M M"]:
        """A diag(w) A^T for each row of weights."""
        by_point, weights = projected.mT.contiguous(), weights.contiguous()
        _, rows, num_points = weights.shape
        sums = self._new(rows, self._size, self._size)
        self._call("gram", num_points, by_point.data_ptr(), rows, weights.data_ptr(), sums.data_ptr())
        return sums

    def _new(self, *shape: int) -> Tensor:
        return self._kept_alive[0].new_empty(self._chains, *shape)

    def _call(self, name: str, *arguments: object) -> None:
        function: Callable[..., int] = getattr(_library(), name)
        share = -(-self._chains // torch.get_num_threads())
        ranges = [(first, min(first + share, self._chains)) for first in range(0, self._chains, share)]
        if compiler.in_threads(lambda first, last: function(self._layer, *arguments, first, last), ranges):
            raise MemoryError("could not allocate the scratch space of a layer, some hundred kilobytes a thread")


@cache
def _library() -> ctypes.CDLL | None:
    library = compiler.load(SOURCE)
    if library is not None:
        for name, arguments in _ARGUMENTS.items():
            function = getattr(library, name)
            function.argtypes = (ctypes.POINTER(_Layer), *arguments, _Count, _Count)
            function.restype = _Count
        library.kernel_number.argtypes, library.kernel_number.restype = (ctypes.c_char_p,), _Count
    return library


@cache
def _kernel_number(kernel: Kernel) -> int | None:
    """The number of this kernel in the compiled code; None if that does not have it."""
    library = _library()
    number = -1 if library is None else int(library.kernel_number(kernel.name.encode()))
    return None if number < 0 else number
