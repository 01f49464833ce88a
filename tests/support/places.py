"""Where things lie in the repository."""

from pathlib import Path

SUPPORT = Path(__file__).parent  # a child process that works here can import the helpers
DATA = SUPPORT.parent / "data"
ROOT = SUPPORT.parents[1]
