"""Outer optimisers: the paper's NES and evosax's algorithms behind one small contract."""

from sejax.es.base import Evaluations, Strategy

__all__ = ["Evaluations", "Strategy"]
