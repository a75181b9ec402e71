"""Lines of progress, and the final message of `sejax.run`."""

import shlex
import time

from sejax.bilevel import Bilevel
from sejax.ops.scores import reaches
from sejax.options import as_text, registry
from sejax.runs import presets
from sejax.runs.config import LearnConfig
from sejax.runs.run_directory import RunDirectory
from sejax.runs.trackers import FinishedGeneration


class RunProgress:
    """Prints a line for each generation, and at the start a line if the task has no tuned settings.

    Args:
      config: the run's configuration.
      is_quiet: whether nothing is printed.
    """

    def __init__(self, config: LearnConfig, is_quiet: bool = False):
        self._config = config
        self._is_quiet = is_quiet
        self._started = time.monotonic()
        self._steps = 0
        env, proxy = config.name("env"), config.name("proxy")
        if f"{env}-{proxy}" not in presets.PRESETS:
            self.say(f"env={env} has no tuned settings for proxy={proxy} (docs/defaults.md).")

    def status(self, text: str) -> None:
        """Prints a step of the work before a generation; steps per second count from it on."""
        self._started = time.monotonic()
        self._steps = 0
        self.say(f"{text} ...")

    def say(self, text: str) -> None:
        """Prints a line."""
        if not self._is_quiet:
            print(text, flush=True)

    def on_generation(self, info: FinishedGeneration) -> None:
        """Prints the numbers of a generation; steps per second are a mean."""
        self._steps += info.train_steps
        steps_per_s = self._steps / max(time.monotonic() - self._started, 1e-9)
        values = info.values
        start = "incumbent_mean_"  # a mixture has such a column for each agent
        means = [f"{x.removeprefix(start)} {values[x]:.1f}" for x in values if x.startswith(start)]
        by_agent = f" ({', '.join(means)})" if means else ""
        text = (
            f"generation {info.generation}/{self._config.generations - 1}: "  # from 0, as in files
            f"search mean {values['incumbent_mean']:.1f} ± {values['incumbent_std']:.1f}"
            f"{by_agent}, best {values['best_so_far']:.1f}, "
            f"{values['train_steps_mean']:,.0f} steps an agent, {steps_per_s:,.0f} steps/s"
        )
        if values["num_nonfinite"]:
            text += f", {values['num_nonfinite']:.0f} diverged"
        self.say(text)

    def finish(self, directory: RunDirectory, bilevel: Bilevel, best: float) -> None:
        """Says how the run ended, where its files are, and what to do next."""
        path = directory.folder
        solved_score = bilevel.solved_score
        is_solved = solved_score is not None and reaches(best, solved_score)
        verdict = f"best search mean {best:.1f}"
        if solved_score is not None:
            verdict = f"{'' if is_solved else 'not '}solved: {verdict}, solved at {solved_score:g}"
        elif bilevel.scoring.objective.meaning:
            verdict += f": {bilevel.scoring.objective.meaning}"
        # The user must type the names of plugins: no name in a file is imported.
        env, proxy = self._config.name("env"), self._config.name("proxy")
        choices = {"env": env, "proxy_kind": proxy, "exploration": self._config.name("exploration")}
        typed = {"proxy": path} | {field: x for field, x in choices.items() if ":" in x}
        agents = {k: registry.name_of("agent", x) for k, x in self._config.agents.items()}
        if any(":" in name for name in agents.values()):
            typed |= {f"agents.{key}": name for key, name in agents.items()}
            typed["agent_hparams"] = "as_learned"
        words = shlex.join(f"{field}={as_text(x)}" for field, x in typed.items())
        arguments = ", task=YOUR_TASK" if ":" in env else ""
        arguments += ", proxy=YOUR_CONFIG" if ":" in proxy else ""
        self.say(
            f"\n{bilevel.proxy.task.name}: {'solved' if is_solved else 'finished'}\n"
            f"{verdict}\n\n"
            f"  {path}/proxy.safetensors    the best proxy\n"
            f"  {path}/learning_curve.png   how it was learned\n"
            f"  {path}/metrics.csv          a row for each generation\n\n"
            "Train fresh agents on it, and on the real task beside them:\n"
            f"  python -m sejax.evaluate {words} num_agents=20\n"
            "Use it as a gymnax environment:\n"
            f'  env, params = sejax.load("{path}"{arguments})'
        )
