"""One law, two machines: arithmetic that runs on tensors and compiles to the Warp simulator.

An effect writes its law once, with + - * /, `sqrt`, `exp`, `where`, ... on scalars and `Vec3`. Called with
torch tensors it is the plain reference; called with `Traced` scalars it writes C++ for a native Warp function,
in which a `Lane` is one float on CUDA and sixteen worlds side by side in one SIMD register on CPU.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor


class Code:
    """Statements written so far; each traced operation adds one."""

    def __init__(self, prefix: str):
        self.prefix = prefix
        self.lines: list[str] = []

    def emit(self, expression: str, kind: str = "Lane") -> Traced:
        """Append `const kind name = expression;` and return the name as a value."""
        name = f"{self.prefix}{len(self.lines)}"
        self.lines.append(f"const {kind} {name} = {expression};")
        return Traced(self, name)


@dataclass(frozen=True, eq=False)
class Traced:
    """A scalar (or condition) known only by its C++ name."""

    code: Code
    name: str

    def _binary(self, other: Scalar, operator: str, swap: bool = False, kind: str = "Lane") -> Traced:
        right = _text(other)
        left, right = (right, self.name) if swap else (self.name, right)
        return self.code.emit(f"{left} {operator} {right}", kind)

    def __add__(self, other: Scalar) -> Traced:
        return self._binary(other, "+")

    def __radd__(self, other: Scalar) -> Traced:
        return self._binary(other, "+", swap=True)

    def __sub__(self, other: Scalar) -> Traced:
        return self._binary(other, "-")

    def __rsub__(self, other: Scalar) -> Traced:
        return self._binary(other, "-", swap=True)

    def __mul__(self, other: Any) -> Any:
        return NotImplemented if isinstance(other, Vec3) else self._binary(other, "*")

    def __rmul__(self, other: Scalar) -> Traced:
        return self._binary(other, "*", swap=True)

    def __truediv__(self, other: Scalar) -> Traced:
        return self._binary(other, "/")

    def __rtruediv__(self, other: Scalar) -> Traced:
        return self._binary(other, "/", swap=True)

    def __neg__(self) -> Traced:
        return self.code.emit(f"-{self.name}")

    def __lt__(self, other: Scalar) -> Traced:
        return self._binary(other, "<", kind="auto")

    def __gt__(self, other: Scalar) -> Traced:
        return self._binary(other, ">", kind="auto")


Scalar = Traced | Tensor | float


@dataclass(frozen=True)
class Vec3:
    """Three scalars with the usual vector arithmetic; a tensor (..., 3) becomes one with `Vec3.of`."""

    x: Any
    y: Any
    z: Any

    @staticmethod
    def of(tensor: Tensor) -> Vec3:
        """Components of a tensor (..., 3)."""
        return Vec3(*tensor.unbind(-1))

    def tensor(self) -> Tensor:
        """Back to (..., 3); only for tensor components."""
        return torch.stack(torch.broadcast_tensors(self.x, self.y, self.z), dim=-1)

    def __add__(self, other: Vec3) -> Vec3:
        return Vec3(self.x + other.x, self.y + other.y, self.z + other.z)

    def __sub__(self, other: Vec3) -> Vec3:
        return Vec3(self.x - other.x, self.y - other.y, self.z - other.z)

    def __mul__(self, s: Scalar) -> Vec3:
        return Vec3(self.x * s, self.y * s, self.z * s)

    __rmul__ = __mul__

    def __neg__(self) -> Vec3:
        return Vec3(-self.x, -self.y, -self.z)

    def dot(self, other: Vec3) -> Any:
        """Scalar product."""
        return self.x * other.x + self.y * other.y + self.z * other.z

    def cross(self, other: Vec3) -> Vec3:
        """Vector product."""
        return Vec3(
            self.y * other.z - self.z * other.y,
            self.z * other.x - self.x * other.z,
            self.x * other.y - self.y * other.x,
        )

    def norm(self) -> Any:
        """Length; safe at zero (returns 1e-12)."""
        return sqrt(self.dot(self) + 1e-24)


def sqrt(a: Any) -> Any:
    """Square root."""
    return a.code.emit(f"lane_sqrt({a.name})") if isinstance(a, Traced) else torch.sqrt(torch.as_tensor(a))


def exp(a: Any) -> Any:
    """Exponential."""
    return a.code.emit(f"lane_exp({a.name})") if isinstance(a, Traced) else torch.exp(torch.as_tensor(a))


def log(a: Any) -> Any:
    """Natural logarithm of a positive scalar."""
    return a.code.emit(f"lane_log({a.name})") if isinstance(a, Traced) else torch.log(torch.as_tensor(a))


def sin(a: Any) -> Any:
    """Sine of an angle [rad]."""
    return a.code.emit(f"lane_sin({a.name})") if isinstance(a, Traced) else torch.sin(torch.as_tensor(a))


def cos(a: Any) -> Any:
    """Cosine of an angle [rad]."""
    return a.code.emit(f"lane_cos({a.name})") if isinstance(a, Traced) else torch.cos(torch.as_tensor(a))


def interpolate(values: Sequence[Any], place: Any) -> Any:
    """Straight lines between `values` at places 0, 1/(K-1), ..., 1; `place` is the same in all worlds."""
    first = values[0]
    if isinstance(first, Traced):
        return first.code.emit(f"lane_interpolate(&{first.name}, {len(values)}, {_unlaned(place.name)})")
    stacked = torch.stack([torch.as_tensor(v, dtype=_dtype(place)) for v in values])
    scaled = (torch.as_tensor(place) * (len(values) - 1)).clamp(0, len(values) - 1)
    below = scaled.floor().long().clamp_max(len(values) - 2)
    rest = scaled - below
    if stacked.dim() == 1:
        return stacked[below] * (1.0 - rest) + stacked[below + 1] * rest
    rows = stacked.flatten(1).T  # (W, K)
    index = below.expand(rows.shape[0], -1)
    return rows.gather(1, index) * (1.0 - rest) + rows.gather(1, index + 1) * rest


def where(condition: Any, a: Any, b: Any) -> Any:
    """`a` where the condition holds, else `b`, per world."""
    if isinstance(condition, Traced):
        return condition.code.emit(f"lane_select({condition.name}, {lane_text(a)}, {lane_text(b)})")
    return torch.where(condition, torch.as_tensor(a, dtype=_dtype(a, b)), torch.as_tensor(b, dtype=_dtype(a, b)))


def maximum(a: Any, b: Any) -> Any:
    """The larger of two scalars, per world."""
    return where(a > b, a, b)


def minimum(a: Any, b: Any) -> Any:
    """The smaller of two scalars, per world."""
    return where(a < b, a, b)


def _unlaned(name: str) -> str:
    """The float inside `Lane(...)`: a place is not a lane of worlds."""
    if not (name.startswith("Lane(") and name.endswith(")")):
        raise TypeError("interpolate needs the place itself, not an expression of it")
    return name[5:-1]


def _dtype(*values: Any) -> torch.dtype:
    return next((v.dtype for v in values if isinstance(v, Tensor)), torch.get_default_dtype())


def _text(value: Scalar) -> str:
    if isinstance(value, Traced):
        return value.name
    if isinstance(value, (int, float)):
        return lane_text(value)
    raise TypeError(f"a law cannot mix traced values with {type(value).__name__}")


def lane_text(value: Scalar) -> str:
    """C++ text of a traced value or a number."""
    return value.name if isinstance(value, Traced) else f"Lane({float(value)!r}f)"
