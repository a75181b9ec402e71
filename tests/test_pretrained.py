"""The proxies that ship: what is said of them."""

import dataclasses
import math
import re
import shlex
import sys
from pathlib import Path

import pytest
from support import evaluation, refused

import sejax
from sejax.distill.__main__ import DistillConfig
from sejax.options.plain import configure
from sejax.proxies import header, zoo
from sejax.runs.fresh_agents import worlds_of
from tools import make_zoo, ship_proxy

PROXIES = {proxy.name: proxy for proxy in sejax.pretrained()}
ROOT = Path(__file__).parents[1]


# --- what is said of them ------------------------------------------------------------------------


@pytest.mark.parametrize("proxy", PROXIES.values(), ids=list(PROXIES))
def test_each_has_a_card_that_says_what_it_teaches_and_what_it_cost(proxy):
    learning, name = proxy.learning, proxy.name
    assert proxy.policy_return is not None or proxy.scores
    assert all(map(math.isfinite, proxy.scores.values()))
    assert proxy.on_proxy and all(x.num_agents >= 10 for x in proxy.on_proxy)
    counts = [learning.generations, learning.real_steps]
    said = [f"`{proxy.task}`", f'sejax.load("{name}")', "Apache-2.0", learning.command]
    said += [f"{x.return_mean:.1f} ± {x.return_std:.1f}" for x in proxy.evaluations]
    said += [f": {count}\n" for count in counts]
    assert proxy.card.startswith(f"# {name}\n") and all(text in proxy.card for text in said)
    assert min(counts) > 0
    if proxy.kind == "se":
        assert learning.cpu_s > 0 and learning.train_steps > learning.agents
        assert learning.generations >= proxy.generation
    (words,) = re.findall(r"`python -m sejax\.evaluate (.*)` trains agents", proxy.card)
    worlds = worlds_of(evaluation(words.split()))
    best = max(proxy.on_proxy, key=lambda evaluation: evaluation.return_mean)
    assert best.agent in worlds["the proxy"].trainings, "the command trains what did best"


@pytest.mark.parametrize("name", PROXIES)
def test_the_command_of_each_composes_what_its_file_was_learned_with(name):
    proxy, stored = PROXIES[name], sejax.load_proxy(name)
    words = shlex.split(proxy.learning.command)[3:]
    if proxy.policy_return is not None:
        config = DistillConfig.of_words(words)
        assert config.search.generations == proxy.learning.generations
        assert [x.agent for x in proxy.on_proxy] == list(stored.learned_agents())
    else:
        config = sejax.config(words)
        assert config.generations == proxy.learning.generations
    assert config.env == configure("env", stored.config["env"])
    agents = stored.learned_agents()
    first = agents[next(iter(agents))].discount  # of a policy there is none
    assert stored.discount == (1.0 if proxy.policy_return is not None else first)
    assert all(stored.learned_with(group) for group in ("exploration", "es", "objective"))
    if proxy.kind == "se":
        assert config.training == sejax.training_of(stored)
    if proxy.kind == "se" and proxy.policy_return is None:
        assert config.proxy == stored.env.config and config.es == stored.learned_with("es")


def test_the_curves_beside_a_set_tell_what_its_proxies_cost():
    stored = "results/reward_networks/cartpole/reward_threshold/exclusive_potential.safetensors"
    path, proxy = ROOT / stored, sejax.load_proxy("cartpole-rn")
    learning = ship_proxy.learning_of(path, proxy)["learning"]
    assert learning == dataclasses.asdict(PROXIES["cartpole-rn"].learning)


def test_the_page_is_what_the_tool_makes():
    assert make_zoo.PAGE.read_text(encoding="utf-8") == make_zoo.page()


def test_the_page_says_which_algorithms_solve_the_task():
    rows = {name: make_zoo.row(proxy) for name, proxy in PROXIES.items()}
    assert rows["halfcheetah"]["solved by"] == "none"  # at most 1,646 of 3,000
    assert rows["halfcheetah"]["not by"] == "ppo, td3"
    assert "sac" in rows["acrobot"]["solved by"]
    assert rows["acrobot"]["not by"] == "td3_discrete"  # -128, others reach -85
    assert rows["cliff_walking-rn"]["solved by"] == "q_learning"


def test_a_proxy_is_shipped_with_what_it_teaches(tmp_path, monkeypatch, capsys):
    (each, *_) = PROXIES["cartpole"].evaluations
    monkeypatch.setattr(ship_proxy, "evaluate", lambda *_: [dataclasses.asdict(each)])
    monkeypatch.setattr(sys, "argv", ["ship_proxy.py", "cartpole", "mine", "--out", str(tmp_path)])
    ship_proxy.main()
    assert "# mine" in capsys.readouterr().out
    shipped = zoo.describe(header.read(tmp_path / "mine.safetensors"))
    assert shipped.evaluations == (each,) and shipped.scores == PROXIES["cartpole"].scores


@pytest.mark.parametrize(("name", "value"), [("hparams", "other"), ("return_mean", [])])
def test_an_evaluation_of_another_shape_is_refused(tmp_path, name, value):
    proxy = sejax.load_proxy("cartpole")
    evaluation = dataclasses.asdict(PROXIES["cartpole"].evaluations[0])
    path = tmp_path / "odd.safetensors"
    evaluations = [evaluation | {name: value}]
    sejax.save(path, proxy.env, proxy.params.weights, evaluations=evaluations)
    assert refused(zoo.describe, header.read(path)) == "record.evaluations"
