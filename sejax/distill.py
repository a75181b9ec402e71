"""`python -m sejax.distill`: an SE made of a policy, chosen by the agents that it teaches."""

import shlex
from collections.abc import Sequence

from sejax.distillation.config import DistillConfig, folder_of, read
from sejax.distillation.policy_copy import CopyConfig
from sejax.distillation.policy_search import SearchConfig
from sejax.ops.files import FolderLock
from sejax.options import as_text, help_texts, require
from sejax.options.plain import fields_of, flatten, to_plain
from sejax.runs import commands, runtime

ABOUT = """Make an SE of a policy, and choose it by what it teaches.

  python -m sejax.distill env=hopper
  python -m sejax.distill env=halfcheetah agents=[td3,sac,ppo] search.generations=200
  python -m sejax.distill env=pendulum policy=sac:model.zip

A linear policy is found by augmented random search. The best policies of parts of the search become
SEs; students train on each, and the SE that teaches best is kept. With `policy`, that one is used.
Other fields are those of sejax.run with preset=distilled. Writes proxy.safetensors, card.md,
search.csv and students.csv into run_dir; the same command goes on with a search that was stopped.
"""


def main(overrides: Sequence[str]) -> None:
    """Distils as the overrides say.

    Raises:
      ConfigError: for overrides that cannot be, or a folder of another search.
      OSError: if a file cannot be written.
    """
    from sejax.distillation import distilling

    own, config = read(overrides)
    runtime.configure_jax()
    folder = folder_of(own, config)
    require(
        not (folder / "checkpoint.safetensors").exists(),
        "run_dir",
        f"must not be a run of sejax.run, whose proxy would be lost; got {folder}. Set "
        "run_dir=FOLDER.",
    )
    lock = FolderLock(folder, "Set run_dir=FOLDER.")
    try:
        distilling.distill(own, config, folder, shlex.join(overrides))
    except KeyboardInterrupt as stop:
        commands.interrupted(f"Interrupted. The same command goes on from {folder}.", stop)
    finally:
        lock.release(is_used=(folder / distilling.ASKED).exists())


def help_text(overrides: Sequence[str]) -> str:
    """What `--help` prints."""
    texts = dict(help_texts(DistillConfig))
    for part in (CopyConfig, SearchConfig):
        texts |= {f"{part.group}.{name}": x for name, x in help_texts(part).items()}
    lines = [
        f"  {name}={as_text(default)}" + (f"  # {texts[name]}" if name in texts else "")
        for name, default in flatten(to_plain(fields_of(DistillConfig))).items()
    ]
    return "\n".join([ABOUT, "Its own fields, with their defaults:", *lines])


if __name__ == "__main__":
    commands.start(main, help_text)
