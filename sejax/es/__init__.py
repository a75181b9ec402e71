"""Outer optimisers: the paper's NES and evosax's algorithms behind one small contract."""

from sejax.es.base import Strategy as Strategy
