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
from mass_engine.evaluation.heldout import REFINED, REFINED_LABEL, RefinedScores, number, read_report

FILE_NAME = "report.html"
#: Most held-out frames on the sheet, and the views around the hand.
_SHEET, _ORBIT = 8, (-120, -60, 0, 60, 120, 180)
#: Curves of at most so many points have a dot at each.
_DOTTED = 60
_STYLE = """
body{font:15px/1.45 system-ui,sans-serif;margin:1.5rem auto;max-width:70rem;padding:0 1rem;
color:#222;background:#fff}
h1{font-size:1.5rem}h2{font-size:1.15rem;margin:1.6rem 0 .4rem}
h1,h2{line-height:1.2;overflow-wrap:anywhere}
table{border-collapse:collapse;margin:.3rem 0}
td,th{border:1px solid #ccc;padding:.15rem .6rem;text-align:left;vertical-align:top;overflow-wrap:anywhere}
td.n{text-align:right;font-variant-numeric:tabular-nums}
figure{margin:0}figcaption{font-size:.8rem;color:#666}
.plots{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(22rem,100%),1fr));gap:1rem}
.sheet{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(9rem,45%),1fr));gap:.4rem}
.sheet.wide{grid-template-columns:repeat(auto-fill,minmax(min(16rem,100%),1fr))}
.sheet img{width:100%;display:block;background:#111}
svg{width:100%;height:auto;background:#fafafa;border:1px solid #ddd}.note{color:#666}
@media(prefers-color-scheme:dark){body{background:#181818;color:#ddd}td,th{border-color:#444}
svg{background:#222;border-color:#444}.note,figcaption{color:#aaa}}
"""
#: What the metrics of a report are called on its page.
_NAMES = {
    "psnr_in_mask": "PSNR in the mask, dB",
    "psnr_hand_on_black": "PSNR of the hand on black, dB",
    "silhouette_iou": "silhouette IoU",
}
_COLORS = ("#0072B2", "#D55E00", "#009E73")


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
        _section("The clip and its renders", _previews(run, report)),
        _section("The avatar", _views(avatar)),
        _section("Time", _times(report)),
        _section("Warnings", _warnings(report)),
        _section("What the fit chose", _choices(report)),
        _section("Settings", _settings(report["options"])),
        _section("The clip, the machine, the versions", _surroundings(report)),
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
    """Numbers to the right, texts to the left; nothing at all without rows."""
    if not rows:
        return ""
    lines = ["<tr>" + "".join(f"<th>{html.escape(cell)}</th>" for cell in head) + "</tr>"] if head else []
    for first, *rest in rows:
        cells = "".join(f"<td{_kind(cell)}>{html.escape(str(cell))}</td>" for cell in rest)
        lines.append(f"<tr><td>{html.escape(str(first))}</td>{cells}</tr>")
    return f"<table>{''.join(lines)}</table>"


def _kind(cell: object) -> str:
    try:
        float(str(cell))
    except ValueError:
        return ""
    return " class=n"


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
            [_NAMES.get(name, name), number(value), *([number(second.get(name))] if second else [])]
            for name, value in evaluation["metrics"].items()
        ]
        head = ["metric", "held-out frames", *([REFINED_LABEL] if second else [])]
        return _table(rows, head)
    again = RefinedScores(**report.get(REFINED, {}))
    rows = [
        [_NAMES.get(name, name), number(value), *([again.cell(name, 3)] if again.frames else [])]
        for name, value in report.get("metrics", {}).items()
    ]
    head = ["metric", f"{kind.replace('heldout', 'held-out')} frames"]
    if again.frames:
        head.append(f"{len(again.frames)} of them, {REFINED_LABEL}")
    return _table(rows, head)


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
        charts.append(_plot(_NAMES[name], "frame", lines))
    return _plots(charts)


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
    return _plots(charts) or "<p class=note>This report holds no curves.</p>"


def _plots(charts: Sequence[str]) -> str:
    drawn = "".join(charts)
    return f"<div class=plots>{drawn}</div>" if drawn else ""


def _plot(title: str, x_label: str, lines: Mapping[str, Sequence[tuple[float, Any]]]) -> str:
    """A small line chart as SVG, its title below."""
    width, height, left, right, bottom, top = 480, 190, 52, 14, 24, 14
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

    def across(x: float) -> float:
        return left + (x - min(xs)) / span * (width - left - right)

    def down(y: float) -> float:
        return height - bottom - (y - low) / (high - low) * (height - bottom - top)

    digits = max(0, 2 - math.floor(math.log10(high - low)))
    drawn = []
    for share in (0.0, 0.5, 1.0):
        value = low + share * (high - low)
        drawn.append(
            f"<line x1={left} x2={width - right} y1={down(value):.1f} y2={down(value):.1f} "
            "stroke=currentColor stroke-opacity=.15 />"
            f"<text x={left - 6} y={down(value) + 4:.1f} font-size=11 text-anchor=end fill=currentColor>"
            f"{value:.{digits}f}</text>"
        )
    for row, points in enumerate(kept.values()):
        color = _COLORS[row % len(_COLORS)]
        places = [(across(x), down(y)) for x, y in points]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
        drawn.append(f"<polyline fill=none stroke={color} stroke-width=1.6 points='{path}'/>")
        if len(places) <= _DOTTED:
            drawn += [f"<circle cx={x:.1f} cy={y:.1f} r=2.6 fill={color} />" for x, y in places]
    drawn.append(
        f"<text x={left} y={height - 6} font-size=11 fill=currentColor>"
        f"{html.escape(x_label)} {min(xs):g}</text>"
        f"<text x={width - right} y={height - 6} font-size=11 text-anchor=end fill=currentColor>"
        f"{max(xs):g}</text>"
    )
    names = [
        f"<span style='color:{_COLORS[row % len(_COLORS)]}'>&#9679; {html.escape(name)}</span>"
        for row, name in enumerate(kept)
        if name and len(kept) > 1
    ]
    return (
        f"<figure><svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {width} {height}' "
        f"role=img aria-label='{html.escape(title)}'>{''.join(drawn)}</svg>"
        f"<figcaption>{html.escape(title)} {' '.join(names)}</figcaption></figure>"
    )


def _previews(run: Path, report: Mapping[str, Any]) -> str:
    """Frames of the clip, each beside its render."""
    held = set(report["frames"].get("heldout", []))
    pictures = []
    for path in sorted((run / "previews").glob("frame-*.jpg"))[:_SHEET]:
        index = int(path.stem.removeprefix("frame-"))
        label = f"frame {index}" + (", held out" if index in held else "")
        pictures.append(_embedded(path.read_bytes(), "jpeg", label))
    return f"<div class='sheet wide'>{''.join(pictures)}</div>" if pictures else ""


def _views(avatar: Avatar) -> str:
    """The best frame's pose from around, and the named poses."""
    pictures = []
    specs = [(f"frame:{avatar.best_frame}", f"orbit:{yaw},0") for yaw in _ORBIT]
    specs += [(name, "orbit:0,0") for name in ("rest", "fist", "point", "pinch", "spread")]
    for pose, camera in specs:
        image = avatar.render(pose, camera, 256, 256)
        yaw = camera.removeprefix("orbit:").split(",")[0]
        name = pose.replace(":", " ")
        label = name if yaw == "0" else f"{name} from {yaw}°"
        pictures.append(_embedded(_png(image), "png", label))
    return f"<div class=sheet>{''.join(pictures)}</div>"


def _png(rgba: NDArray[np.uint8]) -> bytes:
    done, data = cv2.imencode(".png", cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA))
    assert done
    return bytes(data)


def _embedded(data: bytes, kind: str, label: str) -> str:
    text = base64.b64encode(data).decode("ascii")
    name = html.escape(label)
    picture = f"<img alt='{name}' title='{name}' src='data:image/{kind};base64,{text}'>"
    return f"<figure>{picture}<figcaption>{name}</figcaption></figure>"


def _times(report: Mapping[str, Any]) -> str:
    return _table([[name, f"{value:.1f}"] for name, value in report.get("seconds", {}).items()],
                  ["stage", "seconds"])  # fmt: skip


def _warnings(report: Mapping[str, Any]) -> str:
    rows = [[w.get("code", ""), w.get("message", "")] for w in report.get("warnings", [])]
    return _table(rows, ["code", "message"])


def _choices(report: Mapping[str, Any]) -> str:
    """What the fit decided from the clip, and how often it had to step back."""
    fit = report.get("fit", {})
    rows: list[list[object]] = []
    for part in ("capacity", "deformation", "exposure"):
        rows += [[f"{part}: {name}", _text(value)] for name, value in _flat(fit.get(part, {}))]
    last = list(fit.get("covered", {}).values())[-1:]  # what is ignored in the end
    rows += [[f"covered by something: {name}", _text(value)] for look in last for name, value in look.items()]
    rows += [[name, fit[name]] for name in ("undone_steps", "start_jitter_radians") if name in fit]
    return _table(rows, ["what", "value"])


def _settings(options: Mapping[str, Any]) -> str:
    return _table([[name, _text(value)] for name, value in _flat(options)], ["setting", "value"])


def _surroundings(report: Mapping[str, Any]) -> str:
    rows: list[list[object]] = []
    for part in ("video", "machine", "versions"):
        rows += [[f"{part}: {name}", _text(value)] for name, value in report.get(part, {}).items()]
    return _table(rows, ["what", "value"])


def _flat(values: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Names and values, those of a mapping one line each."""
    found: list[tuple[str, Any]] = []
    for name, value in values.items():
        inner = value.items() if isinstance(value, Mapping) else None
        found += [(name, value)] if inner is None else [(f"{name}: {key}", one) for key, one in inner]
    return found


def _text(value: object) -> object:
    """Words instead of Python's."""
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "; ".join(
            ", ".join(f"{key} {_text(one)}" for key, one in item.items())
            if isinstance(item, Mapping) else str(_text(item))
            for item in value
        )  # fmt: skip
    return {"None": "-", "True": "yes", "False": "no"}.get(str(value), value)
