"""Proxies shared on the Hugging Face Hub: the file, and a model card made of what it says."""

from pathlib import Path
from typing import Any

import yaml

from sejax import registry
from sejax.errors import require
from sejax.proxies import card, hub, stored, zoo

TAGS = {"se": "synthetic-environment", "rn": "reward-network"}


def push(
    source: str | Path,
    repo: str,
    *,
    private: bool = False,
    license: str = "apache-2.0",
    message: str = "A proxy of sejax",
) -> str:
    """Puts a proxy on the Hugging Face Hub, from where `sejax.load("hf://user/repo")` loads it.

    Writes `proxy.safetensors` and its card, `README.md`, in one commit, in the place of those that
    are there. Needs the extra `hub`, and a token that may write (`hf auth login`).

    Args:
      source: of one proxy, as of `sejax.load`.
      repo: `user/repo`; made if it is not there.
      private: whether a new repository is.
      license: by the name that the Hub knows it by; that of the shipped proxies if not given.
      message: of the commit.

    Returns:
      Its address, which `sejax.load` takes.

    Raises:
      ConfigError: if there is no such proxy, it is a set, or the repository cannot be written.
    """
    path = stored.find(source)
    _, header = stored.read(path, "source")
    require(
        not header["is_set"],
        "source",
        "be a single proxy",
        "a card is of one",
        f"{path}, a set",
        "source to a run directory or a file of one",
    )
    proxy = zoo.describe(path, name=repo.rpartition("/")[2])
    address = f"{hub.SCHEME}{repo}"
    text = card.card_of(proxy, address, _needs(header["config"]), license)
    files = {hub.FILE: path.read_bytes(), "README.md": (_front(proxy, license) + text).encode()}
    hub.upload(repo, files, message, private)
    return address


def _needs(config: dict[str, Any]) -> list[str]:
    """The arguments that `sejax.load` needs for a file: its names are never imported."""
    arguments = {"env": "task", "proxy": "proxy"}
    return [
        argument
        for group, argument in arguments.items()
        if not registry.is_registered(group, str(config[group].get("name")))
    ]


def _front(proxy: zoo.PretrainedProxy, license: str) -> str:
    """What the Hub reads of a card, in YAML."""
    kinds = [TAGS[proxy.kind]] if proxy.kind in TAGS else []
    values = {
        "library_name": "sejax",
        "license": license,
        "pipeline_tag": "reinforcement-learning",
        "tags": ["reinforcement-learning", "jax", *kinds, proxy.task],
    }
    return f"---\n{yaml.safe_dump(values, sort_keys=False)}---\n\n"
