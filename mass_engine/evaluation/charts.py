"""Figures as SVG and PNG, drawn by matplotlib where it is installed (the extra ``charts``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mass_engine.errors import EngineError


@dataclass(frozen=True)
class Series:
    """One line or cloud of a chart: places ``x``, values ``y``, and what the points are called (optional)."""

    name: str
    x: Sequence[float]
    y: Sequence[float]
    labels: Sequence[str] = ()
    line: bool = True
    marker: str = "o"
    emphasis: bool = False


@dataclass(frozen=True)
class Chart:
    """A titled pair of axes; ``log_x`` for times and sizes."""

    title: str
    x_label: str
    y_label: str
    series: Sequence[Series]
    log_x: bool = False


def draw(chart: Chart, path: Path) -> list[Path]:
    """Write PATH.svg and PATH.png. Raises EngineError ``charts.missing`` without matplotlib."""
    figure = _canvas()
    axes = figure.subplots()
    for one in chart.series:
        axes.plot(
            one.x,
            one.y,
            linestyle="-" if one.line else "none",
            marker=one.marker,
            label=one.name,
            markersize=11 if one.emphasis else 5,
            linewidth=1.2,
            zorder=3 if one.emphasis else 2,
        )
        for place, label in enumerate(one.labels):
            axes.annotate(
                label, (one.x[place], one.y[place]), fontsize=6, xytext=(3, 3), textcoords="offset points"
            )
    if chart.log_x:
        axes.set_xscale("log")
    return _finish(figure, axes, chart.title, chart.x_label, chart.y_label, path)


def draw_bars(title: str, y_label: str, values: Mapping[str, Mapping[str, float]], path: Path) -> list[Path]:
    """A group of bars for each key of ``values``, one bar a method. Writes PATH.svg and PATH.png."""
    figure = _canvas()
    axes = figure.subplots()
    methods = list(dict.fromkeys(method for group in values.values() for method in group))
    width = 0.8 / max(len(methods), 1)
    for row, method in enumerate(methods):
        places = [group + (row - (len(methods) - 1) / 2) * width for group in range(len(values))]
        axes.bar(places, [group.get(method, 0.0) for group in values.values()], width, label=method)
    axes.set_xticks(range(len(values)), list(values), rotation=30, ha="right")
    return _finish(figure, axes, title, "", y_label, path)


def _canvas() -> Any:
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise EngineError(
            "charts.missing",
            "Charts need matplotlib, which is not installed.",
            "Install the extra: pip install 'mass-hand[charts]'.",
        ) from error
    figure = Figure(figsize=(7.0, 4.6), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _finish(figure: Any, axes: Any, title: str, x_label: str, y_label: str, path: Path) -> list[Path]:
    axes.set_title(title, fontsize=10)
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.grid(alpha=0.3)
    handles, _ = axes.get_legend_handles_labels()
    if len(handles) > 1:
        axes.legend(fontsize=7)
    path.parent.mkdir(parents=True, exist_ok=True)
    written = [path.with_name(f"{path.name}.{kind}") for kind in ("svg", "png")]
    # No date and a fixed seed for ids: equal figures are equal files.
    import matplotlib as mpl

    with mpl.rc_context({"svg.hashsalt": path.name}):
        figure.savefig(written[0], metadata={"Date": None})
    figure.savefig(written[1])
    return written
