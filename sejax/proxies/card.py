"""A proxy's model card, in Markdown.

Shipped files carry theirs, of which `docs/zoo.md` is made; `sejax.push` puts one beside the file.
"""

from collections.abc import Sequence

from sejax import registry
from sejax.proxies import hub
from sejax.proxies.zoo import Evaluation, Learning, PretrainedProxy

KINDS = {"se": "synthetic environment (SE)", "rn": "reward network (RN)"}
ENDS = {
    "threshold": "an episode terminates where the done output exceeds 1/2",
    "bernoulli": "an episode terminates with the probability that the done output is",
    "sigmoid": "an episode terminates with the probability that the done output's sigmoid is",
    "soft": 'agents must bootstrap with `info["discount"]`, through which it teaches: '
    "`terminated` alone tells them nothing",
}


SHIPPED_LICENCE = "Apache-2.0, as sejax, which made it: no data of anybody's is in it."
_SCORES = {  # what a score says, where it is no return
    "reward_threshold": " (minus the training steps until the task was solved, and a penalty where "
    "it was not)",
}
_WORDS = {"task": "env", "proxy": "proxy_kind"}  # what arguments of `sejax.load` are in commands


def card_of(
    proxy: PretrainedProxy,
    source: str | None = None,
    needs: Sequence[str] = (),
    licence: str = SHIPPED_LICENCE,
) -> str:
    """The card; of what is not known it says nothing.

    Args:
      proxy: what is known of it.
      source: that `sejax.load` takes; the proxy's name if None.
      needs: the arguments that `sejax.load` takes beside it, as a file's names are not imported.
      licence: a sentence, or the licence's name.
    """
    parts = [f"# {proxy.name}", _about(proxy)]
    if proxy.evaluations:
        parts += ["## What it teaches", _lesson(proxy)]
    if proxy.scores and proxy.learning:
        parts += [
            "## How it was learned, and what that cost",
            f"{_origin(proxy)}\n\n{_cost(proxy, proxy.learning)}",
        ]
    elif proxy.scores:
        parts += ["## How it was learned", _origin(proxy)]
    usage = _usage(proxy, source or proxy.name, needs)
    return "\n\n".join([*parts, "## How to use it", usage, "## Licence", licence])


def _about(proxy: PretrainedProxy) -> str:
    if proxy.kind not in KINDS:
        return (
            f"A proxy for the task `{proxy.task}`, of the kind `{proxy.kind}`, which is its "
            f"author's own."
        )
    if proxy.kind == "rn":
        return (
            f"A {KINDS['rn']} for the task `{proxy.task}`: the dynamics are the real task's, "
            f"the reward is made by a small learned network, so that agents like those it was "
            f"learned with need fewer steps for the real task, where they are tested. To "
            f"others it may do nothing, or harm."
        )
    starts = {
        "real": "the real task's",
        "learned": "made by a network from noise",
        "noise": "standard normal noise",
    }
    return (
        f"A {KINDS['se']} that stands in for the task `{proxy.task}`: small networks make the "
        f"rewards and states of a world of its own. Agents train on it alone, without a step of "
        f"the real task, and are then used there. Do not expect its states or rewards to be like "
        f"the real ones.\n\n"
        f"Initial states are {starts[proxy.initial_state]}. {_episodes(proxy)}"
    )


def _episodes(proxy: PretrainedProxy) -> str:
    if proxy.horizon == 1:
        length = "An episode is one step, after which it terminates: a contextual bandit."
    else:
        most = f"{proxy.horizon} steps" if proxy.horizon else "as many steps as the real task's"
        length = f"Episodes have at most {most}; {ENDS[proxy.ends]}."
    if proxy.ends == "soft":
        return length
    return (
        f"{length} It is a Markov decision process like any other: observation, reward, "
        f"`terminated` and `truncated` say all that there is to know, so that any agent may "
        f"learn on it."
    )


def _lesson(proxy: PretrainedProxy) -> str:
    """What fresh agents reached, as a table."""
    rows = "\n".join(_row(each) for each in proxy.evaluations)
    return (
        f"Fresh agents, each trained for the steps given and then tested on the real task "
        f"(mean and standard deviation of the agents' mean returns):\n\n"
        f"| agent | hyperparameters | trained on | return | training steps | agents |\n"
        f"| --- | --- | --- | --- | --- | --- |\n{rows}"
    )


def _row(each: Evaluation) -> str:
    hparams = {"default": "default", "varied": "drawn for each", "as_learned": "as it was learned"}
    world = {"proxy": "this proxy", "real": "the real task"}
    return (
        f"| {each.agent} | {hparams[each.hparams]} | {world[each.world]} | "
        f"{each.return_mean:.1f} ± {each.return_std:.1f} | {each.train_steps:,.0f} | "
        f"{each.num_agents} |"
    )


def _origin(proxy: PretrainedProxy) -> str:
    scores = ", ".join(f"{agent} {score:.1f}" for agent, score in proxy.scores.items())
    numbers = {"generation": proxy.generation, "seed": proxy.seed}
    place = [f"{name} {number}" for name, number in numbers.items() if number is not None]
    which = f"it is the proxy of {' of '.join(place)}, when it" if place else "it"
    meaning = _SCORES.get(proxy.objective, "")
    return (
        f"With agents of {' and '.join(proxy.agents)}, by an evolution strategy that sees only how "
        f"they do on the real task (Ferreira et al., ICLR 2022): {which} scored {scores}{meaning}."
    )


def _cost(proxy: PretrainedProxy, learning: Learning) -> str:
    return (
        f"    {learning.command}\n\n"
        f"The whole run: {learning.cpu_s:,.0f} CPU seconds, {learning.generations} generations, "
        f"{learning.agents:,} agents trained for {learning.train_steps:,} steps on the proxies; "
        f"{learning.real_steps:,} steps on the real task"
        + (", all of them tests." if proxy.kind == "se" else ".")
    )


def _words_of_best(proxy: PretrainedProxy) -> str:
    """Words for `sejax.evaluate` that train the agents which learned best."""
    best = max(proxy.on_proxy, key=lambda each: each.return_mean, default=None)
    if best is None:
        return ""
    if best.hparams != "as_learned":
        return f" agent={best.agent}" + (
            " agent_hparams=varied" if best.hparams == "varied" else ""
        )
    of_sejax = [
        registry.find("agent", name)
        for name in proxy.agents
        if registry.is_registered("agent", name)
    ]
    # Who is solved for on an SE cannot train on the real task beside it.
    alone = any(agent.is_solved_for for agent in of_sejax)
    return " agent_hparams=as_learned" + (" baseline=false" if alone else "")


def _usage(proxy: PretrainedProxy, source: str, needs: Sequence[str]) -> str:
    given = "".join(f", {name}=..." for name in needs)
    words = "".join(f" {_WORDS[name]}=..." for name in needs)
    words += _words_of_best(proxy)
    call = f'("{source}"{given})'
    gym = f"env = sejax.gym.make{call}  # a gymnasium.Env, in NumPy: any agent, no JAX\n"
    install = "With `pip install 'sejax[hub]'`:\n\n" if hub.is_address(source) else ""
    return (
        f"{install}```python\nimport sejax\n\n{gym if proxy.kind == 'se' else ''}"
        f"env, params = sejax.load{call}  # a gymnax environment, in JAX\n```\n\n"
        f"`python -m sejax.evaluate proxy={source}{words}` trains agents on it and tests them on "
        f"the real task."
    )
