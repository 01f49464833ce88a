"""Sweeps over cases, and their results."""

from .analysis import QueryError, Results, Run, open_results
from .ranking import Ranking

__all__ = ["QueryError", "Ranking", "Results", "Run", "open_results"]
