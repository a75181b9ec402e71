"""Learned stand-ins for real tasks, as gymnax environments whose params are weights."""

from sejax.proxies.base import MAX_ABS_VALUE as MAX_ABS_VALUE
from sejax.proxies.base import ProxyConfig as ProxyConfig
from sejax.proxies.base import ProxyEnv as ProxyEnv
from sejax.proxies.base import ProxyParams as ProxyParams
