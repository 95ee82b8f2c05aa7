"""``mass-engine report RUN``: one static HTML page of a fit, with nothing loaded from elsewhere.

Curves come from report.json where it has any; per-frame scores and stage times are always drawn. Pictures are
the run's own previews and renders of the avatar, as data in the page. No matplotlib: the few curves are SVG
written here, so that a plain installation has its report.
"""

from __future__ import annotations

import base64
import html
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mass_engine.avatar import Avatar
from mass_engine.evaluation.heldout import FILE_NAME as EVALUATION
from mass_engine.evaluation.heldout import REFINED, number, read_report

FILE_NAME = "report.html"
#: Most held-out frames on the sheet, and the views around the hand.
_SHEET, _ORBIT = 8, (-120, -60, 0, 60, 120, 180)
_STYLE = """
body{font:15px/1.45 system-ui,sans-serif;margin:2rem auto;max-width:70rem;padding:0 1rem;color:#222}
table{border-collapse:collapse;margin:.5rem 0}td,th{border:1px solid #ccc;padding:.2rem .6rem;text-align:left}
td.n{text-align:right;font-variant-numeric:tabular-nums}h1,h2{line-height:1.2}
.sheet img{height:11rem;margin:2px;background:#111}figure{margin:.5rem 0}
svg{background:#fafafa;border:1px solid #ddd;max-width:100%}.note{color:#666}
@media(prefers-color-scheme:dark){body{background:#181818;color:#ddd}td,th{border-color:#444}
svg{background:#222;border-color:#444}.note{color:#aaa}}
"""


def write_report(run: Path, out: Path | None = None) -> Path:
    """Write RUN/report.html (or ``out``). Raises ``eval.no_run``, ``avatar.*``."""
    report = read_report(run)
    avatar = Avatar.load(run)
    evaluation = _evaluation(run)
    name = html.escape(str(report["video"].get("name", "a fit")))
    parts = [
        f"<h1>{name}: {html.escape(report['side'])} hand</h1>",
        _summary(report),
        _section("Scores", _scores(report, evaluation)),
        _section("Frame by frame", _per_frame(report, evaluation)),
        _section("Curves of the fit", _curves(report)),
        _section("The clip and its renders", _previews(run)),
        _section("The avatar", _views(avatar)),
        _section("Time", _times(report)),
        _section("Warnings", _warnings(report)),
        _section("Settings", _settings(report)),
    ]
    page = (
        "<!doctype html><html lang=en><meta charset=utf-8>"
        "<meta name=viewport content='width=device-width,initial-scale=1'>"
        f"<title>Fit of {name}</title><style>{_STYLE}</style>"
        f"<body>{''.join(parts)}</body></html>\n"
    )
    target = out or run / FILE_NAME
    target.write_text(page, encoding="utf-8")
    return target


def _evaluation(run: Path) -> dict[str, Any]:
    """RUN/evaluation.json, where ``mass-engine eval RUN`` has left one."""
    try:
        return dict(json.loads((run / EVALUATION).read_text()))
    except (OSError, ValueError):
        return {}


def _section(title: str, content: str) -> str:
    return f"<h2>{title}</h2>{content}" if content else ""


def _table(rows: Sequence[Sequence[object]], head: Sequence[str] = ()) -> str:
    lines = ["<tr>" + "".join(f"<th>{html.escape(cell)}</th>" for cell in head) + "</tr>"] if head else []
    for first, *rest in rows:
        cells = "".join(f"<td class=n>{html.escape(str(cell))}</td>" for cell in rest)
        lines.append(f"<tr><td>{html.escape(str(first))}</td>{cells}</tr>")
    return f"<table>{''.join(lines)}</table>" if lines else ""


def _summary(report: Mapping[str, Any]) -> str:
    frames, surfels = report["frames"], report.get("surfels", {})
    total = sum(report.get("seconds", {}).values())
    memory = report.get("peak_memory_bytes", 0) / 2**20
    return (
        f"<p>{surfels.get('kept', '?')} surfels; {len(frames.get('fitted', []))} frames fitted, "
        f"{len(frames.get('heldout', []))} held out, of {frames.get('tracked', '?')} that show the hand; "
        f"{total:.0f} s, {memory:.0f} MiB at most.</p>"
    )


def _scores(report: Mapping[str, Any], evaluation: Mapping[str, Any]) -> str:
    kind = str(report.get("scored_frames", {}).get("kind", ""))
    rows: list[list[object]]
    if evaluation:
        second = evaluation.get(REFINED, {}).get("metrics", {})
        rows = [
            [name, number(value), *([number(second.get(name))] if second else [])]
            for name, value in evaluation["metrics"].items()
        ]
        head = ["metric", "held-out frames", *(["after test-time pose refinement"] if second else [])]
        return _table(rows, head)
    rows = [[name, number(value)] for name, value in report.get("metrics", {}).items()]
    return _table(rows, ["metric", f"{kind} frames"])


def _per_frame(report: Mapping[str, Any], evaluation: Mapping[str, Any]) -> str:
    rows = evaluation.get("per_frame") or report.get("per_frame", [])
    if len(rows) < 2:
        return ""
    charts = []
    for name in ("psnr_in_mask", "psnr_hand_on_black", "silhouette_iou"):
        lines = {"held out" if evaluation else "scored": [(row["index"], row.get(name)) for row in rows]}
        if REFINED in evaluation:
            refined = evaluation[REFINED]["per_frame"]
            lines["refined"] = [(row["index"], row.get(name)) for row in refined]
        charts.append(_plot(name, "frame", lines))
    return "".join(charts)


def _curves(report: Mapping[str, Any]) -> str:
    """Every curve of report.json: ``curves`` maps a name to a list of values or of (place, value)."""
    curves = report.get("curves") or {}
    charts = []
    for name, values in curves.items() if isinstance(curves, Mapping) else ():
        if not isinstance(values, Sequence) or not values:
            continue
        points = [
            (float(v[0]), v[1]) if isinstance(v, Sequence) else (float(row), v)
            for row, v in enumerate(values)
        ]
        charts.append(_plot(str(name), "step", {"": points}))
    return "".join(charts) or "<p class=note>This report holds no curves.</p>"


def _plot(title: str, x_label: str, lines: Mapping[str, Sequence[tuple[float, Any]]]) -> str:
    """A small line chart as SVG."""
    width, height, left, bottom, top = 640, 200, 60, 34, 26
    kept = {
        name: [(float(x), float(y)) for x, y in points if y is not None and math.isfinite(float(y))]
        for name, points in lines.items()
    }
    every = [point for points in kept.values() for point in points]
    if not every:
        return ""
    xs, ys = [x for x, _ in every], [y for _, y in every]
    low, high = min(ys), max(ys)
    if high - low < 1e-12:
        low, high = low - 0.5, high + 0.5
    span = max(max(xs) - min(xs), 1e-12)

    def place(x: float, y: float) -> str:
        across = left + (x - min(xs)) / span * (width - left - 12)
        return f"{across:.1f},{height - bottom - (y - low) / (high - low) * (height - bottom - top):.1f}"

    drawn = []
    for row, (name, points) in enumerate(kept.items()):
        color = ("#1f77b4", "#d62728", "#2ca02c")[row % 3]
        drawn.append(
            f"<polyline fill=none stroke={color} stroke-width=1.6 "
            f"points='{' '.join(place(x, y) for x, y in points)}'/>"
        )
        if name:
            at = left + 160 + 110 * row
            drawn.append(f"<text x={at} y=16 font-size=12 fill={color}>{html.escape(name)}</text>")
    labels = (
        f"<text x={left} y=16 font-size=13 fill=currentColor>{html.escape(title)}</text>"
        f"<text x=4 y={top + 8} font-size=11 fill=currentColor>{high:.4g}</text>"
        f"<text x=4 y={height - bottom} font-size=11 fill=currentColor>{low:.4g}</text>"
        f"<text x={left} y={height - 10} font-size=11 fill=currentColor>{min(xs):g}</text>"
        f"<text x={width - 12} y={height - 10} font-size=11 text-anchor=end fill=currentColor>"
        f"{html.escape(x_label)} {max(xs):g}</text>"
    )
    return (
        f"<figure><svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {width} {height}' width={width} "
        f"role=img aria-label='{html.escape(title)}'>{labels}{''.join(drawn)}</svg></figure>"
    )


def _previews(run: Path) -> str:
    files = sorted((run / "previews").glob("frame-*.jpg"))[:_SHEET]
    pictures = [_embedded(path.read_bytes(), "jpeg", path.stem) for path in files]
    return f"<div class=sheet>{''.join(pictures)}</div>" if pictures else ""


def _views(avatar: Avatar) -> str:
    """The best frame's pose from around, and the named poses."""
    pictures = []
    specs = [(f"frame:{avatar.best_frame}", f"orbit:{yaw},0") for yaw in _ORBIT]
    specs += [(name, "orbit:0,0") for name in ("rest", "fist", "point", "pinch", "spread")]
    for pose, camera in specs:
        image = avatar.render(pose, camera, 256, 256)
        label = f"{pose} {camera.removeprefix('orbit:')}"
        pictures.append(_embedded(_png(image), "png", label))
    return f"<div class=sheet>{''.join(pictures)}</div>"


def _png(rgba: NDArray[np.uint8]) -> bytes:
    done, data = cv2.imencode(".png", cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA))
    assert done
    return bytes(data)


def _embedded(data: bytes, kind: str, label: str) -> str:
    text = base64.b64encode(data).decode("ascii")
    name = html.escape(label)
    return f"<img alt='{name}' title='{name}' src='data:image/{kind};base64,{text}'>"


def _times(report: Mapping[str, Any]) -> str:
    return _table([[name, f"{value:.1f}"] for name, value in report.get("seconds", {}).items()],
                  ["stage", "seconds"])  # fmt: skip


def _warnings(report: Mapping[str, Any]) -> str:
    rows = [[w.get("code", ""), w.get("message", "")] for w in report.get("warnings", [])]
    return _table(rows, ["code", "message"])


def _settings(report: Mapping[str, Any]) -> str:
    rows: list[list[object]] = [[name, value] for name, value in report["options"].items()]
    rows += [[f"video: {name}", value] for name, value in report["video"].items()]
    rows += [[f"version: {name}", value] for name, value in report.get("versions", {}).items()]
    rows += [[f"machine: {name}", value] for name, value in report.get("machine", {}).items()]
    return _table(rows, ["setting", "value"])
