"""`python -m sejax`, or `sejax`: `sejax run ...` is `python -m sejax.run ...`."""

import runpy
import sys

from sejax.options import nearest, shortened
from sejax.runs import commands

COMMANDS = {
    "run": "learn an SE or a reward network for a task: sejax run env=cartpole",
    "evaluate": "train fresh agents on a learned proxy: sejax evaluate proxy=cartpole",
    "check": "is a learned proxy more than a policy: sejax check proxy=cartpole",
    "search": "search hyperparameters: sejax search env=cartpole 'es.noise_std=interval(0.01, 1)'",
    "distill": "make an SE of a policy: sejax distill env=cartpole policy=ppo:FILE.zip",
}


def main() -> None:
    """Runs the command that the first word names; without a word, or with --help, lists all."""
    name, *words = sys.argv[1:] or ["--help"]
    lines = [f"  {command:9} {about}" for command, about in COMMANDS.items()]
    usage = "\n".join(["Commands:", *lines, "sejax COMMAND --help lists the fields of a command."])
    if name in commands.HELP:
        print(usage)
        return
    if name not in COMMANDS:
        meant = f"run {name}" if "=" in name else nearest(name, COMMANDS)[0]
        message = f"There is no command {shortened(name)}. Write sejax {shortened(meant)}."
        commands.fail(f"{message}\n{usage}", commands.BAD_INPUT)
    sys.argv[1:] = words
    runpy.run_module(f"sejax.{name}", run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
