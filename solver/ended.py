"""How a run ended, as its run.json says."""

from pathlib import Path
from typing import Any

from .durable import read_json

SUCCEEDED = "succeeded"
ENDS = (SUCCEEDED, "failed", "interrupted", "refused")
BEFORE = {"done": SUCCEEDED}  # words of earlier versions


def read_run(directory: Path) -> dict[str, Any]:
    """run.json of a run directory, in the words of now; empty where it is not there or torn."""
    record = read_json(directory / "run.json")
    if (state := record.get("state")) in BEFORE:
        record["state"] = BEFORE[state]
    return record
