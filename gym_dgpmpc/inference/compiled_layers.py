"""One layer of all chains in compiled code: `native/layers.cpp`, which `layers.py` calls where it can.

The same arithmetic as in PyTorch, several times faster on a CPU: what lies between two products stays in the cache,
products with triangular matrices leave the zeros out, and results differ by the rounding of double precision alone.
Chains do not meet, so each thread takes its share of them.
"""

import ctypes
from collections.abc import Callable
from functools import cache

import torch
from jaxtyping import Bool, Float
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
        ("linear", _Doubles),
        ("own_slope", _Doubles),
        ("inverse", _Doubles),
    )


class _Points(ctypes.Structure):
    _fields_ = (
        ("count", _Count),
        ("outputs", _Count),
        ("whitened", _Doubles),
        ("scaled", _Doubles),
        ("projected", _Doubles),
        ("slope", _Doubles),
        ("mean", _Doubles),
        ("variance", _Doubles),
        ("mean_bar", _Doubles),
        ("variance_bar", _Doubles),
        ("whitened_bar", _Doubles),
        ("points_bar", _Doubles),
        ("inducing_bar", _Doubles),
        ("log_lengthscale_bar", _Doubles),
        ("log_variance_bar", _Doubles),
        ("log_slope_bar", _Doubles),
    )


_ARGUMENTS = {
    "own_correlations": (_Doubles, _Doubles),
    "invert": (_Doubles, _Doubles),
    "see": (_Count, _Doubles, _Count, _Doubles, _Doubles, _Doubles),
    "moments": (_Count, _Doubles, _Count, _Doubles, _Doubles, ctypes.c_double, _Doubles, _Doubles),
    "back": (ctypes.POINTER(_Points),),
    "gram": (_Count, _Doubles, _Count, _Doubles, _Doubles),
    "copy": (_Count, _Doubles, _Doubles, _Doubles),
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

    Large matrices that come out are views of memory whose rows are whole vectors. Those that go in are copied to such
    memory if they are not in it.

    Args:
        kernel: of all chains.
        lengthscale, variance: of each.
        centres: inducing inputs over the lengthscales.
        linear: variances of the slopes of the kernel's linear part, if it has one.

    Raises:
        MemoryError: by most methods, where some hundred kilobytes a thread could not be allocated.
    """

    def __init__(
        self,
        kernel: Kernel,
        lengthscale: Float[Tensor, "C D"],
        variance: Float[Tensor, "C"],
        centres: Float[Tensor, "C M D"],
        linear: Float[Tensor, "C D"] | None = None,
    ):
        self._chains, self._size, self._inputs = centres.shape
        self._is_linear = linear is not None
        given = (lengthscale, variance, centres) if linear is None else (lengthscale, variance, centres, linear)
        self._kept_alive = [tensor.contiguous() for tensor in given]
        pointers = (tensor.data_ptr() for tensor in self._kept_alive)
        self._layer = _Layer(_kernel_number(kernel), self._size, self._inputs, *pointers)

    def own_correlations(self) -> tuple[Float[Tensor, "C M M"], Float[Tensor, "C M M"]]:
        """r(Z, Z) and its slopes; the latter are kept for `back`."""
        value, slope = (self._large(self._size) for _ in range(2))
        self._call("own_correlations", value.data_ptr(), slope.data_ptr())
        self._kept_alive.append(slope)
        self._layer.own_slope = slope.data_ptr()
        return value, slope

    def invert(self, factor: Float[Tensor, "C M M"]) -> Float[Tensor, "C M M"]:
        """L^-1 of what `factorise` gives; it is kept for all that follows."""
        upper, inverses = self._in_place(factor.mT), self._large(self._size, 2)
        self._call("invert", upper.data_ptr(), inverses.data_ptr())
        self._kept_alive.append(inverses)
        self._layer.inverse = inverses.data_ptr()
        return inverses[:, 0]

    def see(
        self, x: Float[Tensor, "C n D"]
    ) -> tuple[Float[Tensor, "C n D"], Float[Tensor, "C M n"], Float[Tensor, "C n M"]]:
        """The fields of `layers.Seen`."""
        x = x if x.stride()[1:] == (self._inputs, 1) else x.contiguous()  # chains that see the same need no copies
        num_points = x.shape[1]
        scaled, projected, slope = self._new(num_points, self._inputs), self._large(num_points), self._large(num_points)
        pointers = (tensor.data_ptr() for tensor in (scaled, projected, slope))
        self._call("see", num_points, x.data_ptr(), x.stride(0), *pointers)
        return scaled, projected.mT, slope

    def moments(
        self,
        whitened: Float[Tensor, "C M O"],
        scaled: Float[Tensor, "C n D"],
        projected: Float[Tensor, "C M n"],
        least: float,
    ) -> tuple[Float[Tensor, "C n O"], Float[Tensor, "C n"]]:
        """Mean and variance of `layers.Passed`."""
        whitened, scaled, by_point = whitened.contiguous(), scaled.contiguous(), self._in_place(projected.mT)
        num_points, outputs = by_point.shape[1], whitened.shape[2]
        mean, variance = self._new(num_points, outputs), self._new(num_points)
        self._call(
            "moments", outputs, whitened.data_ptr(), num_points, scaled.data_ptr(), by_point.data_ptr(), least,
            mean.data_ptr(), variance.data_ptr(),
        )  # fmt: skip
        return mean, variance

    def back(
        self,
        whitened: Float[Tensor, "C M O"],
        seen: tuple[Float[Tensor, "C n D"], Float[Tensor, "C M n"], Float[Tensor, "C n M"]],
        passed: tuple[Float[Tensor, "C n O"], Float[Tensor, "C n"]],
        passed_bar: tuple[Float[Tensor, "C n O"], Float[Tensor, "C n"]],
        *,
        of_points: bool,
        of_parameters: bool,
    ) -> tuple[Float[Tensor, "C M O"], Float[Tensor, "C n D"] | None, list[Tensor] | None]:
        """The fields of `layers.LayerGradients`, from the moments and their gradients."""
        scaled, projected, slope = seen
        num_points, outputs = passed[0].shape[1:]
        given = (
            whitened.contiguous(), scaled.contiguous(), self._in_place(projected.mT), self._in_place(slope),
            *(tensor.contiguous() for tensor in (*passed, *passed_bar)),
        )  # fmt: skip
        whitened_bar = self._new(self._size, outputs)
        points_bar = self._new(num_points, self._inputs) if of_points else None
        slopes = [(self._inputs,)] if self._is_linear else []
        shapes = [(self._size, self._inputs), (self._inputs,), (), *slopes] if of_parameters else []
        parameters_bar = [self._new(*shape) for shape in shapes]
        pointers = [tensor.data_ptr() for tensor in (*given, whitened_bar)]
        pointers.append(0 if points_bar is None else points_bar.data_ptr())
        pointers += [tensor.data_ptr() for tensor in parameters_bar]
        self._call("back", ctypes.byref(_Points(num_points, outputs, *pointers)))
        return whitened_bar, points_bar, parameters_bar or None

    def gram(self, projected: Float[Tensor, "C M n"], weights: Float[Tensor, "C T n"]) -> Float[Tensor, "C T M M"]:
        """A diag(w) A^T for each row of weights."""
        by_point, weights = self._in_place(projected.mT), weights.contiguous()
        _, rows, num_points = weights.shape
        sums = self._new(rows, self._size, self._size)
        self._call("gram", num_points, by_point.data_ptr(), rows, weights.data_ptr(), sums.data_ptr())
        return sums

    def put(self, chosen: Bool[Tensor, "C n"], rows: Float[Tensor, "C n M"], into: Float[Tensor, "C n M"]) -> Tensor:
        """``into`` with those rows that are chosen; it is overwritten if its memory is padded."""
        chosen, rows, into = chosen.contiguous(), self._in_place(rows), self._in_place(into)
        self._call("copy", chosen.shape[1], chosen.data_ptr(), rows.data_ptr(), into.data_ptr())
        return into

    def _new(self, *shape: int) -> Tensor:
        return self._kept_alive[0].new_empty(self._chains, *shape)

    def _large(self, rows: int, *several: int) -> Tensor:
        """An uninitialised "C n M" in padded memory."""
        shape = _padded(rows), _padded(self._size)
        return self._new(*several, *shape)[..., :rows, : self._size]

    def _in_place(self, large: Float[Tensor, "C n M"]) -> Float[Tensor, "C n M"]:
        """Itself if it is in padded memory, else a copy that is."""
        _, rows, size = large.shape
        height, width = _padded(rows), _padded(size)
        if large.stride() == (height * width, width, 1):
            return large
        copied = large.new_zeros(len(large), height, width)[:, :rows, :size]
        return copied.copy_(large)

    def _call(self, name: str, *arguments: object) -> None:
        if _in_shares(self._chains, name, self._layer, *arguments):
            raise MemoryError("could not allocate the scratch space of a layer, some hundred kilobytes a thread")


def factorise(covariance: Float[Tensor, "*b M M"], added: float) -> tuple[Float[Tensor, "*b M M"], bool]:
    """`linalg.by_lapack` for float64 on the CPU, where there is compiled code; without a gradient."""
    given = covariance if covariance.stride()[-1] == 1 else covariance.contiguous()
    given = given.flatten(0, -3) if given.ndim > 3 else given
    count, _, size = given.shape
    upper = given.new_empty(count, _padded(size), _padded(size))
    places = given.data_ptr(), given.stride(0), given.stride(1)
    failed = _in_shares(count, "factorise", size, *places, added, upper.data_ptr())
    return upper[:, :size, :size].unflatten(0, covariance.shape[:-2]).mT, not failed


_LONG = frozenset(("see", "back", "gram"))
"""Functions that are worth threads; the others are done sooner than these are woken."""


def _in_shares(count: int, name: str, *arguments: object) -> int:
    """Call a function for so many chains, or matrices, in threads if it is long; the sum of what it returns."""
    function: Callable[..., int] = getattr(_library(), name)
    share = -(-count // torch.get_num_threads()) if name in _LONG else count
    ranges = [(first, min(first + share, count)) for first in range(0, count, share)]
    return compiler.in_threads(lambda first, last: function(*arguments, first, last), ranges)


@cache
def _library() -> ctypes.CDLL | None:
    library = compiler.load(SOURCE, *compiler.SOURCES[SOURCE])
    if library is not None:
        for name, arguments in _ARGUMENTS.items():
            getattr(library, name).argtypes = (ctypes.POINTER(_Layer), *arguments, _Count, _Count)
        library.factorise.argtypes = (_Count, _Doubles, _Count, _Count, ctypes.c_double, _Doubles, _Count, _Count)
        library.kernel_number.argtypes = (ctypes.c_char_p,)
        for name in (*_ARGUMENTS, "factorise", "kernel_number", "unit"):
            getattr(library, name).restype = _Count
    return library


@cache
def _kernel_number(kernel: Kernel) -> int | None:
    """The number of this kernel in the compiled code; None if that does not have it."""
    library = _library()
    number = -1 if library is None else int(library.kernel_number(kernel.name.encode()))
    return None if number < 0 else number


@cache
def _padded(size: int) -> int:
    """The rows or columns that a large matrix of so many takes."""
    library = _library()
    assert library is not None
    unit = int(library.unit())
    return -(-size // unit) * unit
