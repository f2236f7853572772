"""Whole rollouts of a pathwise draw in compiled code: `native/rollout.cpp`, called once per thread and objective.

`PathwiseSampler` evaluates its functions with PyTorch, one step of a plan at a time. The code here takes the same
functions through all steps at once, several times faster on a CPU, and differs only by single-precision rounding.
The compiled code has kernels of its own, which it is asked for by name; one that it does not have is left to PyTorch.
"""

import ctypes
import math
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from gym_dgpmpc import compiler
from gym_dgpmpc.dynamics.coordinates import Coordinates
from gym_dgpmpc.dynamics.noise import PathNoise
from gym_dgpmpc.gp.kernels import Kernel

_Floats = ctypes.POINTER(ctypes.c_float)
_Integers = ctypes.POINTER(ctypes.c_int64)

SOURCE = "dynamics/deep_gp/native/rollout.cpp"

AS_IS, SINE, COSINE, ACTION, FORWARDS, LEFTWARDS = range(6)


class PathwiseLayer(NamedTuple):
    """One layer's functions, ready for a rollout: two products in, two out, in the rollout's precision."""

    kernel: Kernel
    inverse_lengthscale: Float[Tensor, "P D"]
    centres: Float[Tensor, "P D M"]  # from x to the kernel's argument, with ...
    offsets: Float[Tensor, "P M"]  # ... and the factor of |x|^2, which is the kernel's `argument_scale`
    frequencies: Float[Tensor, "P D half_F"]  # from x to the features' angles, in turns
    kernel_out: Float[Tensor, "T P O M"]  # sigma^2 alpha; T = H with refresh="step", else 1
    feature_out: Float[Tensor, "T P O F"]  # sigma sqrt(2 / F) w, of all cosines, then of all sines
    linear_out: Float[Tensor, "T P O D"] | None  # of a linear part, for x over the lengthscales


class _Layer(ctypes.Structure):
    _fields_ = (
        ("kernel", ctypes.c_int64),
        ("argument_scale", ctypes.c_float),
        ("outputs", ctypes.c_int64),
        ("inverse_lengthscale", _Floats),
        ("centres", _Floats),
        ("offsets", _Floats),
        ("frequencies", _Floats),
        ("kernel_out", _Floats),
        ("feature_out", _Floats),
        ("linear_out", _Floats),
    )


class _Task(ctypes.Structure):
    _fields_ = (
        *((f"{name}_size", ctypes.c_int64) for name in ("observation", "action", "input")),
        *((name, ctypes.c_int64) for name in ("num_particles", "num_candidates", "horizon")),
        *((f"num_{name}", ctypes.c_int64) for name in ("layers", "inducing", "features", "functions")),
        ("input_kind", _Integers),
        ("input_source", _Integers),
        ("input_mean", _Floats),
        ("input_scale", _Floats),
        ("carried", _Floats),
        ("shift", _Floats),
        ("spread", _Floats),
        ("target", _Integers),
        ("lowest", _Floats),
        ("highest", _Floats),
        ("num_vectors", ctypes.c_int64),
        ("vectors", _Integers),
        ("layers", ctypes.POINTER(_Layer)),
        ("noise", _Floats),
        ("stretch", _Floats),
        ("centre", _Floats),
        ("start", _Floats),
        ("actions", _Floats),
        ("states", _Floats),
    )


def is_available(kernel: Kernel | None = None) -> bool:
    """Whether there is compiled code for this machine, and this kernel; builds it at the first call: some seconds.

    Warns once if there is, but without the kernel.
    """
    if _library() is None:
        return False
    if kernel is None or _kernel_number(kernel) is not None:
        return True
    compiler.warn_once(f"there is no kernel {kernel.name!r} in {SOURCE}")
    return False


class CompiledRollout:
    """All trajectories of one draw.

    Args:
        layers: the functions, float32 on the CPU.
        coordinates: raw states to standardised coordinates and back, float32.
        noise: what the worlds have of it, if any.

    Raises:
        RuntimeError: there is no compiled code, or it lacks a layer's kernel; see `is_available`.
    """

    def __init__(self, layers: Sequence[PathwiseLayer], coordinates: Coordinates, noise: PathNoise | None = None):
        library = _library()
        if library is None:
            raise RuntimeError("no compiled code on this machine: check is_available() first")
        self._library, encoder, first = library, coordinates.encoder, layers[0]
        self._coordinates, self._noise = coordinates, noise
        self._kept_alive: list[Tensor] = []  # the memory that the structures point into
        self._layers = (_Layer * len(layers))(*map(self._described, layers))
        vectors = encoder.spec.body_frame
        along_body = {x: (FORWARDS, k) for k, (_, x, _) in enumerate(vectors)}
        along_body |= {y: (LEFTWARDS, k) for k, (_, _, y) in enumerate(vectors)}
        inputs = [along_body.get(i, (AS_IS, i)) for i in encoder.plain]
        inputs += [(kind, i) for kind in (SINE, COSINE) for i in encoder.angles]
        inputs += [(ACTION, i) for i in range(encoder.action_size)]
        target = torch.full((encoder.observation_size,), -1, dtype=torch.int64, device="cpu")
        target[encoder.predicted] = torch.arange(encoder.target_size, dtype=torch.int64, device="cpu")
        blur = None if noise is None else noise.observation
        spread = torch.zeros(encoder.observation_size, dtype=torch.float32, device="cpu")
        spread[encoder.predicted] = coordinates.spread
        self._task = _Task(
            observation_size=encoder.observation_size,
            action_size=encoder.action_size,
            input_size=encoder.input_size,
            num_particles=first.kernel_out.shape[1],
            num_layers=len(layers),
            num_inducing=first.kernel_out.shape[-1],
            num_features=first.feature_out.shape[-1],
            num_functions=first.kernel_out.shape[0],
            input_kind=self._integers([kind for kind, _ in inputs]),
            input_source=self._integers([source for _, source in inputs]),
            input_mean=self._floats(coordinates.input_mean),
            input_scale=self._floats(coordinates.input_scale),
            carried=self._floats(coordinates.carried),
            shift=self._floats(coordinates.shift),
            spread=self._floats(spread),
            target=self._integers(target.tolist()),
            lowest=self._floats(coordinates.lowest),
            highest=self._floats(coordinates.highest),
            num_vectors=len(vectors),
            vectors=self._integers(vectors),
            layers=self._layers,
            noise=None if noise is None else self._floats(noise.process),
            stretch=None if blur is None else self._floats(blur.stretch),
            centre=None if blur is None else self._floats(blur.centre),
        )

    def __call__(
        self, observation: Float[Tensor, "S"], actions: Float[Tensor, "K H A"]
    ) -> Float[Tensor, "H_plus_1 P K S"]:
        """The states of every particle under every candidate, the first of them ``observation``.

        From a float64 observation the states are float64, and what is rounded is their distance from it alone.

        Runs on as many threads as PyTorch is set to use, and gives the same values for any number of them.

        Raises:
            ValueError: the sizes are not those of the draw, or the plan has more steps than it has functions.
            MemoryError: a few kilobytes per thread could not be allocated.
        """
        self._check_sizes(observation, actions)
        num_candidates, horizon, _ = actions.shape
        task = _Task.from_buffer_copy(self._task)
        origin, begins = None, observation.expand(task.num_particles, -1)
        errors, blur = (None, None) if self._noise is None else (self._noise.errors, self._noise.observation)
        if errors is not None:
            begins = begins - errors[0]
        if observation.dtype == torch.float64:
            origin = self._origin(observation)
            moved = [tensor.float().contiguous() for tensor in self._about(origin)]
            task.input_mean, task.shift = (_pointer(tensor) for tensor in moved)
            begins = begins - origin
            if blur is not None:
                moved.append((blur.centre - origin).float().contiguous())
                task.centre = _pointer(moved[-1])
        start, points = begins.to(torch.float32).contiguous(), int(self._library.points())
        by_step = pad(actions.to(torch.float32).permute(1, 2, 0), (0, -num_candidates % points)).contiguous()
        states = start.new_empty(horizon + 1, task.num_particles, num_candidates, task.observation_size)
        task.num_candidates, task.horizon = num_candidates, horizon
        task.start, task.actions, task.states = (_pointer(tensor) for tensor in (start, by_step, states))

        def run(first: int, last: int) -> int:
            calls = (self._library.rollout(task, particle, first, last) for particle in range(task.num_particles))
            return sum(calls)

        # Shares of whole vectors: one that is half full costs as much as a full one.
        share = -(-num_candidates // torch.get_num_threads() // points) * points
        ranges = [(first, min(first + share, num_candidates)) for first in range(0, num_candidates, share)]
        if compiler.in_threads(run, ranges):
            raise MemoryError("could not allocate the scratch space of a rollout, a few kilobytes for each thread")
        states = states if origin is None else states + origin
        return states if self._noise is None else self._noise.all_observed(states, observation)

    def _origin(self, observation: Float[Tensor, "S"]) -> Float[Tensor, "S"]:
        """A place near the observation that states can be told from: of an angle whole turns, which change nothing."""
        encoder, origin = self._coordinates.encoder, observation.clone()
        turning = [*encoder.angles, *encoder.vectors.headings]
        origin[turning] = 2 * math.pi * torch.round(observation[turning] / (2 * math.pi))
        origin[[*encoder.vectors.x, *encoder.vectors.y]] = 0.0  # their lengths count, and not only their changes
        return origin

    def _about(self, origin: Float[Tensor, "S"]) -> tuple[Float[Tensor, "D"], Float[Tensor, "S"]]:
        """Means of the inputs, and what is added to a state, where states are told from ``origin``."""
        encoder = self._coordinates.encoder
        mean, shift = self._coordinates.inputs.mean.clone(), self._coordinates.exact_shift
        mean[: len(encoder.plain)] -= origin[encoder.plain]
        return mean, shift - origin * (1.0 - encoder.carried)

    def _check_sizes(self, observation: Tensor, actions: Tensor) -> None:
        """Refuse wrong sizes: the compiled code trusts them, and would read beyond the arrays."""
        task, noise = self._task, self._noise
        longest = task.num_functions if noise is None else len(noise.process)
        if observation.shape != (task.observation_size,):
            raise ValueError(
                f"the observation must have the shape ({task.observation_size},), got {tuple(observation.shape)}"
            )
        if actions.ndim != 3 or actions.shape[2] != task.action_size:
            raise ValueError(f"the actions must have the shape [K, H, {task.action_size}], got {tuple(actions.shape)}")
        if (longest > 1 or noise is not None) and actions.shape[1] > longest:
            raise ValueError(
                f"the actions must not exceed the {longest} steps that these worlds were drawn for, got "
                f"{actions.shape[1]}"
            )

    def _described(self, layer: PathwiseLayer) -> _Layer:
        """A layer as the compiled code is told of it."""
        kernel, *weights = layer
        number = _kernel_number(kernel)
        if number is None:
            raise RuntimeError(f"the compiled code has no kernel {kernel.name!r}: check is_available first")
        pointers = (None if weight is None else self._floats(weight) for weight in weights)
        return _Layer(number, kernel.argument_scale, layer.kernel_out.shape[2], *pointers)

    def _floats(self, values: Tensor) -> "ctypes._Pointer[ctypes.c_float]":
        self._kept_alive.append(values.to(torch.float32).contiguous())
        return _pointer(self._kept_alive[-1])

    def _integers(self, values: Any) -> "ctypes._Pointer[ctypes.c_int64]":
        self._kept_alive.append(torch.tensor(values, dtype=torch.int64, device="cpu"))
        return ctypes.cast(self._kept_alive[-1].data_ptr(), _Integers)


@cache
def _library() -> ctypes.CDLL | None:
    library = compiler.load(SOURCE, *compiler.SOURCES[SOURCE])
    if library is not None:
        library.rollout.argtypes = (ctypes.POINTER(_Task), *(ctypes.c_int64,) * 3)
        library.kernel_number.argtypes = (ctypes.c_char_p,)
        for function in (library.rollout, library.points, library.kernel_number):
            function.restype = ctypes.c_int64
    return library


def _kernel_number(kernel: Kernel) -> int | None:
    """The number of this kernel in the compiled code; None if that does not have it."""
    library = _library()
    number = -1 if library is None else int(library.kernel_number(kernel.name.encode()))
    return None if number < 0 else number


def _pointer(tensor: Tensor) -> "ctypes._Pointer[ctypes.c_float]":
    return ctypes.cast(tensor.data_ptr(), _Floats)
