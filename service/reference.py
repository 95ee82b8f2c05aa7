"""The tables of docs/http.md, from what the program does: ``python -m service.reference`` writes them."""

from __future__ import annotations

from pathlib import Path

from service.jobs.model import FINAL_STATES, TRANSITIONS, JobState
from service.problems import Kind

DOCUMENT = Path(__file__).parents[1] / "docs" / "http.md"

_MEANING = {
    JobState.AWAITING_UPLOAD: "its video is still being sent",
    JobState.QUEUED: "waits for a worker",
    JobState.RUNNING: "a worker has it",
    JobState.CANCELLING: "its worker has been told to stop",
    JobState.SUCCEEDED: "its results are there",
    JobState.FAILED: "`error` says why",
    JobState.CANCELLED: "its owner ended it",
    JobState.EXPIRED: "its video did not come in time",
}


def states() -> str:
    """Each state, what it means, and where it can lead."""
    rows = []
    for state, after in TRANSITIONS.items():
        leads = ", ".join(f"`{target}`" for target in JobState if target in after)
        rows.append(f"| `{state}` | {_MEANING[state]} | {leads or 'final'} |")
    assert len(FINAL_STATES) == sum("final" in row for row in rows)
    return "\n".join(["| state | meaning | next |", "|---|---|---|", *rows])


def errors() -> str:
    """Each error the service answers with."""
    rows = [
        f"| `{kind.code}` | {kind.status} | {kind.title} | {kind.advice} |"
        for kind in sorted(Kind, key=lambda kind: kind.code)
    ]
    return "\n".join(["| code | status | meaning | advice |", "|---|---|---|---|", *rows])


def updated(text: str) -> str:
    """``text`` with its two tables brought up to date."""
    for first, table in (("| state | meaning |", states()), ("| code | status |", errors())):
        start = text.index(first)
        text = text[:start] + table + text[text.index("\n\n", start) :]
    return text


if __name__ == "__main__":
    DOCUMENT.write_text(updated(DOCUMENT.read_text()))
