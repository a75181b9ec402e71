"""Outer optimisers: the paper's NES and evosax's algorithms behind one small contract."""

from sejax.es.strategy import Strategy, make_strategy

__all__ = ["Strategy", "make_strategy"]
