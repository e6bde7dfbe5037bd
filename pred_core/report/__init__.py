"""Self-contained HTML reports: one file, no network, figures and animations inside."""

from pred_core.report.animation import Track, animation
from pred_core.report.page import Page, number

__all__ = ["Page", "Track", "animation", "number"]
