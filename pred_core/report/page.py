"""One HTML file with text, tables and figures inside; nothing is loaded from elsewhere."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

SENTENCE = 25  # characters; a longer cell is no number
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1b1f24; background: #fff; max-width: 1080px; margin: 2em auto;
       padding: 0 1.2em; }
h1 { font-size: 1.7em; margin-bottom: .2em; } h2 { font-size: 1.25em; margin-top: 2em; }
p.note, figcaption { color: #57606a; font-size: .9em; max-width: 75ch; }
table { border-collapse: collapse; margin: .8em 0; font-variant-numeric: tabular-nums; font-size: .92em; }
th, td { padding: .25em .8em; text-align: right; border-bottom: 1px solid #e4e7eb; }
th { border-bottom: 2px solid #57606a; font-weight: 600; } th:first-child, td:first-child { text-align: left; }
td.text { text-align: left; } tr.strong td { font-weight: 650; } tr.warn td { color: #9a3b00; }
figure { margin: 1em 0; } img { max-width: 100%; } code { background: #f2f4f6; padding: .1em .3em; }
.wide { overflow-x: auto; } p.lead { font-size: 1.2em; line-height: 1.45; margin: .8em 0 1em; }
"""


class Page:
    """Collects parts in order; `write` makes the file. All text is escaped."""

    def __init__(self, title: str):
        self.title = title
        self._parts: list[str] = [f"<h1>{html.escape(title)}</h1>"]

    def heading(self, text: str) -> None:
        """A section heading."""
        self._parts.append(f"<h2>{html.escape(text)}</h2>")

    def text(self, text: str, note: bool = False) -> None:
        """A paragraph; `note`: small and grey."""
        self._parts.append(f"<p{' class=note' if note else ''}>{html.escape(text)}</p>")

    def lead(self, text: str) -> None:
        """The sentence a page opens with, larger."""
        self._parts.append(f"<p class=lead>{html.escape(text)}</p>")

    def code(self, text: str) -> None:
        """A command line."""
        self._parts.append(f"<p><code>{html.escape(text)}</code></p>")

    def table(self, header: Sequence[str], rows: Sequence[Sequence[object]], marks: Sequence[str] = ()) -> None:
        """A table. `marks`: per row "", "strong" or "warn"."""
        head = "".join(f"<th>{html.escape(h)}</th>" for h in header)
        body = []
        for i, row in enumerate(rows):
            mark = f' class="{marks[i]}"' if i < len(marks) and marks[i] else ""
            body.append(f"<tr{mark}>" + "".join(_cell(str(c)) for c in row) + "</tr>")
        self._parts.append(f'<div class="wide"><table><tr>{head}</tr>{"".join(body)}</table></div>')

    def figure(self, figure: Figure, caption: str) -> None:
        """A matplotlib figure as vector graphics."""
        buffer = io.BytesIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None})
        data = base64.b64encode(buffer.getvalue()).decode()
        self._parts.append(
            f'<figure><img alt="{html.escape(caption)}" src="data:image/svg+xml;base64,{data}">'
            f"<figcaption>{html.escape(caption)}</figcaption></figure>"
        )

    def html(self, markup: str) -> None:
        """Markup made by this package (an animation); it is not escaped."""
        self._parts.append(markup)

    def write(self, path: Path) -> None:
        """Write the file."""
        head = f'<meta charset="utf-8"><title>{html.escape(self.title)}</title><style>{_STYLE}</style>'
        body = "\n".join(self._parts)
        path.write_text(f'<!doctype html><html lang="en"><head>{head}</head><body>{body}</body></html>\n', "utf-8")


def _cell(text: str) -> str:
    """Sentences are read from the left, numbers stand under each other."""
    return f"<td{' class=text' if len(text) > SENTENCE else ''}>{html.escape(text)}</td>"


def number(value: float | None, digits: int = 3) -> str:
    """A number with `digits` significant digits, an en dash for none."""
    return "–" if value is None else f"{value:.{digits}g}"
