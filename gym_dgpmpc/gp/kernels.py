"""Stationary kernels with ARD as functions of the scaled squared distance r^2 = sum_d (x_d - z_d)^2 / lengthscale_d^2.

The lowest room of the Gaussian-process code: `layer.py` builds covariances from them, `features.py` their spectral
counterpart. A kernel is one object of the class `Kernel`, and `KERNELS` holds all there are: a new one is a class here
and an entry there. Rollouts and training are several times faster if `dynamics/deep_gp/native/rollout.cpp` and
`inference/native/layers.cpp` know its name too.
"""

from abc import ABC, abstractmethod
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor

# Below this r^2 two points are one: rounding of r^2 would show in Matern-1/2, and its slope there is infinite.
_SQDIST_FLOOR = 1e-12

# Range of s^2 (or of r^2 / 2) in rollouts.
_NEAREST, _FARTHEST = 1e-36, 60.0


class Kernel(ABC):
    """A correlation k(r^2) with k(0) = 1, in the forms that training, rollouts and random features need.

    Lengthscales and the variance are the layers' (`layer.Layer`), so a kernel has no state.

    Attributes:
        name: what settings and saved files call it, and compiled rollouts too.
        argument_scale: the factor c for which `correlation_` takes c r^2.
    """

    name: ClassVar[str]
    argument_scale: ClassVar[float]

    @abstractmethod
    def correlation_and_slope(self, sqdist: Float[Tensor, "*b"]) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
        """k(r^2) and dk/d(r^2); no gradient flows through.

        Both at once: training spends most of its time on them, and they share what is costly. Rounding that makes r^2
        negative is taken as zero.
        """

    @abstractmethod
    def correlation_(
        self, argument: Float[Tensor, "*b"], scratch: Float[Tensor, "*b"] | None = None
    ) -> Float[Tensor, "*b"]:
        """k from ``argument`` = `argument_scale` * r^2, overwriting it; no gradient.

        The in-place form for rollouts, which fold the factor into a matrix product. Rounding that makes r^2 negative is
        taken as zero. Values below exp(-60) are given as about exp(-60): single precision would make them subnormal,
        and products of those are a hundred times slower.

        Args:
            scratch: overwritten; with it nothing is allocated, which counts in a rollout's many calls.
        """

    @abstractmethod
    def draw_frequencies(
        self, num_features: int, input_size: int, generator: torch.Generator, dtype: torch.dtype = torch.float64
    ) -> Float[Tensor, "F D"]:
        """Independent draws from the spectral density, the Fourier transform of k at unit lengthscales."""

    def correlation(self, sqdist: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
        """k(r^2), differentiable once."""
        return _Correlation.apply(sqdist, self)

    def __repr__(self) -> str:
        return f"{type(self).__name__}()"


class _Correlation(torch.autograd.Function):
    """k(r^2) with its slope in closed form: no gradient meets the square root of Matern kernels, singular at zero."""

    @staticmethod
    def forward(ctx: Any, sqdist: Tensor, kernel: Kernel) -> Tensor:
        value, slope = kernel.correlation_and_slope(sqdist)
        ctx.save_for_backward(slope)
        return value

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None]:
        (slope,) = ctx.saved_tensors
        return grad_outputs[0] * slope, None


class RBF(Kernel):
    """exp(-r^2 / 2), also called squared exponential; its spectral density is the standard normal."""

    name = "rbf"
    argument_scale = -0.5

    def correlation_and_slope(self, sqdist: Float[Tensor, "*b"]) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
        value = torch.exp(-0.5 * sqdist.clamp_min(0.0))
        return value, -0.5 * value

    def correlation_(
        self, argument: Float[Tensor, "*b"], scratch: Float[Tensor, "*b"] | None = None
    ) -> Float[Tensor, "*b"]:
        return argument.clamp_(-_FARTHEST, 0.0).exp_()

    def draw_frequencies(
        self, num_features: int, input_size: int, generator: torch.Generator, dtype: torch.dtype = torch.float64
    ) -> Float[Tensor, "F D"]:
        return torch.randn(num_features, input_size, generator=generator, dtype=dtype, device=generator.device)


class Matern(Kernel):
    """A Matern kernel of half-integer order nu: a polynomial p(s) times exp(-s), with s = sqrt(2 nu) r.

    Its spectral density is a multivariate Student-t with 2 nu degrees of freedom. A kernel of this family says what its
    polynomial is (Rasmussen and Williams 2006, eq. 4.16) and what its slope,

        dk/d(r^2) = dk/ds ds/d(r^2) = nu (p'(s) - p(s)) / s exp(-s).

    Attributes:
        order: nu.
    """

    order: ClassVar[float]

    @abstractmethod
    def _value_and_slope(self, s: Tensor, decay: Tensor) -> tuple[Tensor, Tensor]:
        """Value and slope, from s and exp(-s)."""

    @abstractmethod
    def _value_(self, s: Tensor, scratch: Tensor | None) -> Tensor:
        """The value, overwriting s."""

    def correlation_and_slope(self, sqdist: Float[Tensor, "*b"]) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
        s = torch.sqrt(2 * self.order * torch.threshold(sqdist, _SQDIST_FLOOR, 0.0))
        return self._value_and_slope(s, torch.exp(-s))

    def correlation_(
        self, argument: Float[Tensor, "*b"], scratch: Float[Tensor, "*b"] | None = None
    ) -> Float[Tensor, "*b"]:
        # Exact zeros would take the vectorised square root's slow path.
        return self._value_(argument.clamp_(_NEAREST, _FARTHEST**2).sqrt_(), scratch)

    def draw_frequencies(
        self, num_features: int, input_size: int, generator: torch.Generator, dtype: torch.dtype = torch.float64
    ) -> Float[Tensor, "F D"]:
        """A standard normal over sqrt(g) with g ~ Gamma(nu, rate nu) shared by the dimensions of one frequency."""
        device = generator.device
        frequency = torch.randn(num_features, input_size, generator=generator, dtype=dtype, device=device)
        # 2 nu is a whole number, so the Gamma variate is a mean of as many squared normals.
        degrees = round(2 * self.order)
        normals = torch.randn(num_features, degrees, generator=generator, dtype=dtype, device=device)
        return frequency / normals.square().mean(-1, keepdim=True).sqrt()


class Matern12(Matern):
    """exp(-s): continuous functions without a slope."""

    name, order, argument_scale = "matern12", 0.5, 1.0

    def _value_and_slope(self, s: Tensor, decay: Tensor) -> tuple[Tensor, Tensor]:
        return decay, -0.5 * decay / s.clamp_min(_SQDIST_FLOOR**0.5)

    def _value_(self, s: Tensor, scratch: Tensor | None) -> Tensor:
        return s.neg_().exp_()


class Matern32(Matern):
    """(1 + s) exp(-s): functions with one derivative."""

    name, order, argument_scale = "matern32", 1.5, 3.0

    def _value_and_slope(self, s: Tensor, decay: Tensor) -> tuple[Tensor, Tensor]:
        return torch.addcmul(decay, s, decay), -1.5 * decay

    def _value_(self, s: Tensor, scratch: Tensor | None) -> Tensor:
        decay = torch.neg(s, out=scratch).exp_()
        return torch.addcmul(decay, s, decay, out=s)


class Matern52(Matern):
    """(1 + s + s^2/3) exp(-s): functions with two derivatives."""

    name, order, argument_scale = "matern52", 2.5, 5.0

    def _value_and_slope(self, s: Tensor, decay: Tensor) -> tuple[Tensor, Tensor]:
        slope = torch.addcmul(decay, s, decay).mul_(-5 / 6)  # (1 + s) exp(-s)
        return torch.addcmul(s, s, s, value=1 / 3).add_(1.0).mul_(decay), slope

    def _value_(self, s: Tensor, scratch: Tensor | None) -> Tensor:
        decay = torch.neg(s, out=scratch).exp_()
        return s.addcmul_(s, s, value=1 / 3).add_(1.0).mul_(decay)


class Matern72(Matern):
    """(1 + s + 2 s^2/5 + s^3/15) exp(-s): functions with three derivatives."""

    name, order, argument_scale = "matern72", 3.5, 7.0

    def _value_and_slope(self, s: Tensor, decay: Tensor) -> tuple[Tensor, Tensor]:
        quadratic = torch.addcmul(s, s, s, value=1 / 3).add_(1.0)  # 1 + s + s^2/3
        # p(s) = 1 + s (1 + 2 s/5 + s^2/15) = quadratic + s^2 (1 + s) / 15
        value = torch.addcmul(quadratic, s.square(), s + 1.0, value=1 / 15).mul_(decay)
        return value, quadratic.mul_(decay).mul_(-7 / 10)

    def _value_(self, s: Tensor, scratch: Tensor | None) -> Tensor:
        # By Horner's rule, so that one tensor beside s is enough: p first, then exp(-s) in the place of s.
        value = torch.mul(s, 1 / 15, out=scratch).add_(2 / 5).mul_(s).add_(1.0).mul_(s).add_(1.0)
        return s.neg_().exp_().mul_(value)


KERNELS: dict[str, Kernel] = {kernel.name: kernel for kernel in (RBF(), Matern72(), Matern52(), Matern32(), Matern12())}
"""Every kernel by its name, from the smoothest functions to the roughest. You may add your own."""

KernelName = Literal["rbf", "matern72", "matern52", "matern32", "matern12"]
"""Those that come with the package: what type checkers and the command line know."""


def find_kernel(kernel: str | Kernel) -> Kernel:
    """The kernel of this name; a kernel is returned as it is.

    Raises:
        ValueError: the name is unknown; the message lists the known ones.
    """
    if isinstance(kernel, Kernel):
        return kernel
    if kernel not in KERNELS:
        raise ValueError(f"unknown kernel {kernel!r}: expected one of {', '.join(KERNELS)}")
    return KERNELS[kernel]


def scaled_sqdist(
    x: Float[Tensor, "*b n D"], z: Float[Tensor, "*c m D"], lengthscale: Float[Tensor, "*c D"]
) -> Float[Tensor, "*b n m"]:
    """r^2 between the rows of ``x`` and ``z``; may be negative by rounding."""
    return sqdist(x / lengthscale.unsqueeze(-2), z / lengthscale.unsqueeze(-2))


def sqdist(x: Float[Tensor, "*b n D"], z: Float[Tensor, "*c m D"]) -> Float[Tensor, "*b n m"]:
    """|x_i - z_j|^2 between the rows of ``x`` and ``z``; may be negative by rounding.

    One matrix product of (x, |x|^2, 1) and (-2 z, 1, |z|^2), so that no other operation has the size of the result.
    """
    left = torch.cat([x, x.square().sum(-1, keepdim=True), torch.ones_like(x[..., :1])], dim=-1)
    right = torch.cat([-2.0 * z, torch.ones_like(z[..., :1]), z.square().sum(-1, keepdim=True)], dim=-1)
    return left @ right.mT


def pairwise_sqdist(x: Float[Tensor, "*b n D"]) -> Float[Tensor, "*b n n"]:
    """|x_i - x_j|^2 between the rows of ``x`` (already divided by the lengthscales); may be negative by rounding."""
    square = x.square().sum(-1)
    return square.unsqueeze(-1) + square.unsqueeze(-2) - 2.0 * (x @ x.mT)
