"""What files and command lines of earlier versions say, in today's words."""

from collections.abc import Mapping
from typing import Any

from sejax.options import registry

# Fields of earlier versions. A file may still set a field to its value here: it changes nothing.
GONE: dict[str, object] = {"agent.torso": None, "agent.num_filters": 16, "agent.loss": "squared"}
GONE |= {f"agent.{x}": 1 for x in ("train_every", "gradient_steps", "target_update_every")}
GONE |= {"baseline": True, "agent.noisy_tests": False, "mixture.compared_by": "advantage"}
GONE |= {"proxy.reward_slope": 1.0, "proxy.horizon_is_terminal": True, "num_seeds": 1}
# What says the same today.
INSTEAD = dict.fromkeys(("num_seeds", "seeds"), "seed=0, or in a sweep seed=0,1,2")


def is_gone(field: str, value: object) -> bool:
    """Whether a field of earlier versions has the value that changes nothing."""
    return field in GONE and GONE[field] == value


def upgraded(config: Mapping[str, Any]) -> dict[str, Any]:
    """A configuration in the form in which files are written today.

    Older versions wrote an only agent as `agent`, and the settings of a mixture among its agents.
    """
    new = {k: x for k, x in config.items() if x is not None or k not in ("agent", "agents")}
    if isinstance(agent := new.get("agent"), Mapping) and isinstance(agent.get("name"), str):
        new["agents"] = {registry.key_of(agent["name"]): new.pop("agent")}
    agents = new.setdefault("agents", {})
    if not isinstance(agents, Mapping) or "mixture" in new:
        return new
    of_all = {name: agents[name] for name in ("aggregate", "compared_by") if name in agents}
    by_key = {key: dict(x) for key, x in agents.items() if isinstance(x, Mapping)}
    weights = {}
    if len(by_key) > 1:  # an only agent may have a field of this name
        weights = {key: x.pop("weight") for key, x in by_key.items() if "weight" in x}
    if of_all or weights:
        new["mixture"] = of_all | {"weights": weights}
    new["agents"] = {key: x for key, x in agents.items() if key not in of_all} | by_key
    return new
