"""Sweeps over cases, and their results."""

from .analysis import Results, Run, open_results

__all__ = ["Results", "Run", "open_results"]
