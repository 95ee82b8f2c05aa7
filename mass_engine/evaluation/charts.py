"""Figures as SVG and PNG, drawn by matplotlib where it is installed (the extra ``charts``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from mass_engine.errors import EngineError

#: Colours that are told apart also by the colour-blind (Okabe and Ito 2008).
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7A5C00", "#8A8A8A", "#000000")
#: Bars that fit side by side on a page.
_STANDING = 24
#: Places along each piece of a line that labels keep away from.
_SAMPLES = 40
#: Where a label may stand, in units of its distance from the point: right, left, above, below, corners.
_AROUND = ((1, 0), (-1, 0), (0, 1), (0, -1), (0.7, 0.7), (-0.7, 0.7), (0.7, -0.7), (-0.7, -0.7))


@dataclass(frozen=True)
class Series:
    """One line or cloud of a chart: places ``x``, values ``y``, short ``labels`` beside the points (optional)
    and what those mean, one line of the legend each (``key``). ``faint``: thin and dotted, not in the legend;
    a ``dotted`` one without points may stand for all of them there.
    """

    name: str
    x: Sequence[float]
    y: Sequence[float]
    labels: Sequence[str] = ()
    line: bool = True
    marker: str = "o"
    color: str = PALETTE[0]
    emphasis: bool = False
    faint: bool = False
    dotted: bool = False
    key: Sequence[str] = ()


@dataclass(frozen=True)
class Chart:
    """A titled pair of axes. ``log_x`` and ``log_y`` for times, sizes and errors; ``ticks`` names the places
    0, 1, ... of an axis without numbers. ``bars``: every series is a bar beside the others', from 0 to the
    full scale ``top``. ``height`` in inches.
    """

    title: str
    x_label: str
    y_label: str
    series: Sequence[Series]
    log_x: bool = False
    log_y: bool = False
    ticks: Sequence[str] = ()
    bars: bool = False
    top: float | None = None
    height: float = 4.8


def draw(charts: Chart | Sequence[Chart], path: Path, stacked: bool = False) -> list[Path]:
    """Write PATH.svg and PATH.png; the legend, of everything that has a name, is on the right. Several charts
    are side by side, or ``stacked`` one above the other on the same x axis.

    Raises EngineError ``charts.missing`` without matplotlib.
    """
    parts = [charts] if isinstance(charts, Chart) else list(charts)
    named: dict[str, Series] = {}
    for one in (one for chart in parts for one in chart.series if one.name and not one.faint):
        named.setdefault(one.name, one)
    legend = list(named.values())
    lines = sum(1 + len(one.key) for one in legend)
    heights = [chart.height for chart in parts]
    high = max(sum(heights) if stacked else max(heights), 0.5 + 0.165 * lines)
    if stacked:
        figure = _canvas(6.6 + 2.2, high)
        panels = figure.subplots(len(parts), 1, squeeze=False, sharex=True, height_ratios=heights)[:, 0]
    else:
        figure = _canvas(5.6 * len(parts) + 2.2, high)
        panels = figure.subplots(1, len(parts), squeeze=False)[0]
    for place, (axes, chart) in enumerate(zip(panels, parts, strict=True)):
        if chart.bars:
            _plot_bars(axes, chart.series)
        for one in () if chart.bars else chart.series:
            _plot(axes, one)
        if chart.top is not None:
            axes.set_ylim(0, chart.top)
        if chart.ticks:
            slanted = max(len(text) for text in chart.ticks) * len(chart.ticks) > 60
            turn = {"rotation": 30, "ha": "right"} if slanted else {}
            axes.set_xticks(range(len(chart.ticks)), list(chart.ticks), **turn)
            axes.set_xlim(-0.45, len(chart.ticks) - 0.55)
        for name, wanted in (("x", chart.log_x), ("y", chart.log_y)):
            if wanted:
                _logarithmic(axes, name)
        lowest = not stacked or place == len(parts) - 1
        _name(axes, chart.title, chart.x_label if lowest else "", chart.y_label)
    figure.align_ylabels()
    _legend(figure, legend)
    figure.canvas.draw()
    for axes, chart in zip(panels, parts, strict=True):
        if not chart.bars:
            _place_labels(axes, chart.series)
    return _write(figure, path)


def draw_bars(title: str, y_label: str, values: Mapping[str, Mapping[str, float]], path: Path) -> list[Path]:
    """A group of bars for each key of ``values``, one bar a method, its value at its end; what has no value
    has no bar. Many groups lie one under the other. Writes PATH.svg and PATH.png."""
    methods = list(dict.fromkeys(method for group in values.values() for method in group))
    lying = len(values) * max(len(methods), 1) > _STANDING
    long = 1.2 + (0.2 if lying else 0.55) * len(values) * max(len(methods), 1)
    figure = _canvas(8.0, max(4.8, long)) if lying else _canvas(max(7.0, long))
    axes = figure.subplots()
    width = 0.8 / max(len(methods), 1)
    for row, method in enumerate(methods):
        places = [place for place, group in enumerate(values.values()) if method in group]
        heights = [group[method] for group in values.values() if method in group]
        shifted = [place + (row - (len(methods) - 1) / 2) * width for place in places]
        bars = (axes.barh if lying else axes.bar)(
            shifted, heights, 0.94 * width, label=method, color=PALETTE[row % len(PALETTE)]
        )
        axes.bar_label(bars, fmt="%.4g", fontsize=7, padding=1)
    if lying:
        axes.set_yticks(range(len(values)), list(values))
        axes.set_ylim(len(values) - 0.5, -0.5)  # the first one on top
        axes.margins(x=0.1)
    else:
        axes.margins(y=0.1)
        axes.set_xticks(range(len(values)), list(values), rotation=30, ha="right")
    _name(axes, title, y_label if lying else "", "" if lying else y_label)
    if len(methods) > 1:
        figure.legend(fontsize=8, loc="outside lower center", ncols=len(methods), frameon=False)
    return _write(figure, path)


def _plot(axes: Any, one: Series) -> None:
    axes.plot(
        one.x,
        one.y,
        linestyle=_style(one),
        marker=one.marker,
        color=one.color,
        markersize=15 if one.emphasis else 3 if one.faint else 6,
        linewidth=0.9 if one.faint else 1.5,
        markeredgecolor="white" if one.emphasis or not (one.line or one.marker == "x") else one.color,
        markeredgewidth=0.8,
        alpha=0.6 if one.faint else 1.0,
        zorder=4 if one.emphasis else 2 if one.faint else 3,
    )


def _style(one: Series) -> str:
    return (":" if one.faint or one.dotted else "-") if one.line else "none"


def _plot_bars(axes: Any, series: Sequence[Series]) -> None:
    width = 0.8 / max(len(series), 1)
    for row, one in enumerate(series):
        shift = (row - (len(series) - 1) / 2) * width
        axes.bar([x + shift for x in one.x], one.y, 0.94 * width, color=one.color)


def _legend(figure: Any, series: Sequence[Series]) -> None:
    from matplotlib.lines import Line2D

    handles = []
    for one in series:
        look: dict[str, Any] = {"linestyle": _style(one), "marker": one.marker}
        size = 11 if one.emphasis else 6
        handles.append(Line2D([], [], color=one.color, label=one.name, markersize=size, **look))
        handles += [Line2D([], [], linestyle="none", label=line) for line in one.key]
    if len(handles) > 1:
        legend = figure.legend(
            handles=handles, fontsize=7.5, loc="outside right upper", frameon=False, labelspacing=0.25
        )
        keys = {line for one in series for line in one.key}
        for text in legend.get_texts():
            text.set_fontweight("normal" if text.get_text() in keys else "bold")


def _logarithmic(axes: Any, name: str) -> None:
    """A logarithmic axis with plain numbers at 1, 2, 5."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    (axes.set_xscale if name == "x" else axes.set_yscale)("log")
    axis = axes.xaxis if name == "x" else axes.yaxis
    axis.set_major_locator(LogLocator(10, (1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: _short(value)))
    axis.set_minor_formatter(NullFormatter())


def _short(value: float) -> str:
    """1500 -> 1.5k."""
    for size, letter in ((1e6, "M"), (1e3, "k")):
        if value >= size:
            return f"{value / size:.3g}{letter}"
    return f"{value:.3g}"


def _place_labels(axes: Any, series: Sequence[Series]) -> None:
    """Labels beside their points: on no other label, point or line, if there is room."""
    scale = axes.figure.dpi / 72
    marked = [one for one in series if one.marker and not one.faint]
    places = {
        id(one): axes.transData.transform(list(zip(one.x, one.y, strict=True))) for one in marked if one.x
    }
    lines = [
        axes.transData.transform(list(zip(one.x, one.y, strict=True))) for one in series if one.line and one.x
    ]
    taken = [
        (x - 4 * scale, y - 4 * scale, x + 4 * scale, y + 4 * scale) for p in places.values() for x, y in p
    ]
    for line in lines:
        for start, end in pairwise(line):
            for share in range(_SAMPLES + 1):
                x, y = (start + (end - start) * share / _SAMPLES).tolist()
                taken.append((x - scale, y - scale, x + scale, y + scale))
    high = 7.5 * scale
    for one in marked:
        for (x, y), text in zip(places.get(id(one), ()), one.labels, strict=False):
            wide = 0.62 * high * len(text)

            def box(
                far: float, turn: tuple[float, float], x: float = x, y: float = y, wide: float = wide
            ) -> _Box:
                middle = x + turn[0] * (far + wide / 2), y + turn[1] * (far + high / 2)
                return (
                    middle[0] - wide / 2,
                    middle[1] - high / 2,
                    middle[0] + wide / 2,
                    middle[1] + high / 2,
                )

            options = [box(far * scale, turn) for far in (5, 9, 14, 20) for turn in _AROUND]
            best = min(options, key=lambda b: sum(_overlap(b, other) for other in taken))
            taken.append(best)
            at = axes.transData.inverted().transform(((best[0] + best[2]) / 2, (best[1] + best[3]) / 2))
            axes.text(*at, text, fontsize=7, ha="center", va="center", color=one.color, zorder=5)


_Box = tuple[float, float, float, float]


def _overlap(one: _Box, two: _Box) -> float:
    wide = min(one[2], two[2]) - max(one[0], two[0])
    high = min(one[3], two[3]) - max(one[1], two[1])
    return max(wide, 0.0) * max(high, 0.0)


def _canvas(width: float, height: float = 4.8) -> Any:
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise EngineError(
            "charts.missing",
            "Charts need matplotlib, which is not installed.",
            "Install the extra: pip install 'mass-hand[charts]'.",
        ) from error
    figure = Figure(figsize=(width, height), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _name(axes: Any, title: str, x_label: str, y_label: str) -> None:
    axes.set_title(title, fontsize=10)
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.grid(alpha=0.3)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _write(figure: Any, path: Path) -> list[Path]:
    path.parent.mkdir(parents=True, exist_ok=True)
    written = [path.with_name(f"{path.name}.{kind}") for kind in ("svg", "png")]
    # No date and a fixed seed for ids: equal figures are equal files.
    import matplotlib as mpl

    with mpl.rc_context({"svg.hashsalt": path.name}):
        figure.savefig(written[0], metadata={"Date": None})
    figure.savefig(written[1])
    return written
