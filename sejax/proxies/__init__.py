"""Learned stand-ins for real tasks, as gymnax environments whose params are weights."""

from sejax.proxies.base import MAX_ABS_VALUE, ProxyConfig, ProxyEnv, ProxyParams

__all__ = ["MAX_ABS_VALUE", "ProxyConfig", "ProxyEnv", "ProxyParams"]
