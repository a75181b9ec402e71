"""Outer optimisers: the paper's NES and evosax's algorithms behind one small contract."""

from sejax.es.strategy import Strategy, Trials

__all__ = ["Strategy", "Trials"]
