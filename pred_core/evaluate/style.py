"""How models look in every figure: colour-blind safe colours (Okabe and Ito), told apart by dashes as well."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes

INK, GREY, GRID = "#1b1f24", "#57606a", "#e4e7eb"
_KNOWN = {
    "pred": ("#0072B2", "-"),
    "extended": ("#009E73", "-"),
    "spring-mass": ("#D55E00", "-"),
    "static-regression": ("#CC79A7", "--"),
    "blended-ends": ("#B07C00", "--"),
    "persistence": ("#7a7a7a", ":"),
    "last-residual": ("#56B4E9", "-."),
    "constant-velocity": ("#a8a8a8", "-."),
}
_OTHERS = (("#5D3A9B", "-"), ("#8C564B", "--"), ("#1b9e9e", "-."), ("#2b2b2b", ":"))


def styles(models: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Colour and dash of each model; the known ones look the same in every report."""
    others = [m for m in models if m not in _KNOWN]
    return {m: _KNOWN[m] if m in _KNOWN else _OTHERS[others.index(m) % len(_OTHERS)] for m in models}


def tidy(axes: Axes, x: str, y: str) -> None:
    """Labels with units, light grid, no box."""
    axes.set_xlabel(x, color=INK)
    axes.set_ylabel(y, color=INK)
    axes.grid(True, color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.tick_params(colors=GREY, labelsize=9)
