"""sejax.agents.mixture: members that take turns among agents, and what their scores make."""

import dataclasses
import re
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sejax
from sejax import envs, registry
from sejax.agents.mixture import COMPARED_BY, Families, FamiliesConfig
from sejax.bilevel import make_bilevel
from sejax.errors import ConfigError
from sejax.es.base import Trials
from sejax.es.nes import NESConfig
from sejax.evaluation import make_evaluator
from sejax.objectives import MaxReward, Outcome
from sejax.proxies.configs import SyntheticConfig
from sejax.scores import Scoring
from sejax.training import TrainingConfig

NAN, INF = np.nan, np.inf
TASK = envs.make("gridworld_2x2")
AGENTS = tuple(
    sejax.make_agent(config, TASK)
    for config in (
        sejax.QLearningConfig(learning_rate=0.5),
        sejax.SARSAConfig(learning_rate=0.3, epsilon_init=0.7, epsilon_min=0.7),
    )
)


def families(num=2, weights=(), **config):
    """Families of which nobody looks at the agents."""
    return Families(agents=AGENTS[:1] * num, weights=weights, config=FamiliesConfig(**config))


# --- who trains what -----------------------------------------------------------------------------


def test_places_are_dealt_to_the_family_that_is_furthest_behind_its_share():
    # Shares 1/2, 1/3 and 1/6; after each place, share times places less places had:
    # 1: 3/6 2/6 1/6 -> 0.  2: 0 4/6 2/6 -> 1.  3: 3/6 0 3/6 -> 0 (a tie goes to the first).
    # 4: 0 2/6 4/6 -> 2.  5: 3/6 4/6 -1/6 -> 1.  6: 6/6 0 0 -> 0.  Then all over again.
    dealt = families(3, weights=(3.0, 2.0, 1.0)).of_members(12)
    np.testing.assert_array_equal(dealt, [0, 1, 0, 2, 1, 0] * 2)
    np.testing.assert_array_equal(families(2).of_members(5), [0, 1, 0, 1, 0])
    np.testing.assert_array_equal(families(1).of_members(3), [0, 0, 0])
    # A family of weight 0 judges incumbents alone, and needs no room among the members.
    np.testing.assert_array_equal(families(2, weights=(0.0, 3.0)).of_members(3), [1, 1, 1])
    np.testing.assert_array_equal(families(2, weights=(0.0, 3.0)).of_members(1), [1])


def test_both_signs_of_a_perturbation_train_the_same_family():
    strategy = NESConfig(population_size=3).make(4)
    assert (strategy.num_members, strategy.num_signs) == (6, 2)
    dealt = families(2).of_members(strategy.num_members, strategy.num_signs)
    np.testing.assert_array_equal(dealt, [0, 1, 0] * 2)
    state = strategy.init(jax.random.key(1), jnp.zeros(4))
    members, _ = strategy.ask(jax.random.key(0), state)
    np.testing.assert_allclose(members[:3], -members[3:], rtol=1e-6)  # which those are


def test_every_trial_has_its_members_family_and_the_incumbents_take_turns():
    trials = Trials(num_evals=2, num_incumbent_evals=4)
    np.testing.assert_array_equal(
        trials.families(np.array([0, 1, 0]), 2), [0, 0, 1, 1, 0, 0, 0, 1, 0, 1]
    )


@pytest.mark.parametrize(("asked", "num", "evals"), [(16, 2, 16), (5, 2, 6), (1, 3, 3), (4, 1, 4)])
def test_the_incumbent_is_tried_by_as_many_agents_of_each_family(asked, num, evals):
    assert families(num).num_evals(asked) == evals


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Families(agents=()), r"^agents must hold an agent, .*; got none\. Set agent=ddqn"),
        (
            lambda: Families(agents=AGENTS, names=("a",)),
            r"^agents must have 2 names and weights, .*; got \('a',\)\. Set names=\(\) and",
        ),
        (
            lambda: Families(agents=AGENTS, weights=(1.0, 2.0, 3.0)),
            r"^agents must have 2 names and weights, .*; got \(1\.0, 2\.0, 3\.0\)\.",
        ),
        (
            lambda: families(2, weights=(0.0, 0.0)),
            r"^agents must have weights of at least 0, and one above, .*; got \(0\.0, 0\.0\)\.",
        ),
        (
            lambda: families(3).of_members(4, num_signs=2),
            r"^es\.population_size must be at least 3, .*; got 2\. Set es\.population_size=3\.$",
        ),
        (
            lambda: families(2, weights=(10.0, 1.0)).of_members(4),
            r"^agents must have weights that leave each family a member, .* 4 perturbations; "
            r"got \(10\.0, 1\.0\)\.",
        ),
        (lambda: FamiliesConfig(aggregate="max"), r"^agents\.aggregate must be one of .* 'max'"),
        (lambda: FamiliesConfig(compared_by="x"), r"^agents\.compared_by must be one of .* 'x'"),
    ],
)
def test_what_families_cannot_be_is_refused(make, message):
    with pytest.raises(ConfigError, match=message):
        make()


# --- what scores make ----------------------------------------------------------------------------

SCORES = np.array([200, -500, 150, NAN, 190, -80, NAN, -500, 10, -90, 180, -100], np.float32)
FAMILY = np.array([0, 1] * 6)


def plain_comparable(scores, family, incumbents, compared_by):
    """The same in plain Python, one member at a time."""
    out = []
    for score, own_family in zip(scores, family, strict=True):
        own = [float(s) for s, f in zip(scores, family, strict=True) if f == own_family]
        alive = [s for s in own if np.isfinite(s)]
        incumbent = incumbents[own_family]
        if not np.isfinite(incumbent):
            incumbent = sum(alive) / len(alive) if alive else NAN

        def share_below(x, own=own):
            return sum(1.0 if s < x else 0.5 if s == x else 0.0 for s in own) / len(own)

        if not np.isfinite(score):
            out.append(NAN)
        elif compared_by == "advantage":
            out.append(float(score) - incumbent)
        else:
            out.append(share_below(float(score)) - share_below(incumbent))
    return out


def compare(scores, family, incumbents, by):
    """`comparable` of as many families as there are incumbents' means, in NumPy."""
    comparable = families(len(incumbents), compared_by=by).comparable
    jitted = jax.jit(lambda scores, means: comparable(scores, np.array(family), means))
    return jax.device_get(jitted(np.float32(scores), np.float32(incumbents)))


@pytest.mark.parametrize("by", COMPARED_BY)
@pytest.mark.parametrize("incumbents", [(160.0, -95.0), (190.0, NAN), (NAN, NAN)])
def test_scores_are_compared_within_their_family(by, incumbents):
    got, incumbent = compare(SCORES, FAMILY, incumbents, by)
    expected = plain_comparable(SCORES, FAMILY, incumbents, by)
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-6)
    assert incumbent == 0.0


@pytest.mark.parametrize("by", COMPARED_BY)
def test_what_ties_with_the_incumbent_but_for_rounding_moves_nothing(by):
    mean = np.float32(-93.3) - np.float32(2e-5)  # as a mean of equal scores may be off
    got, _ = compare([-93.3, 0.0, -93.3, 1.0], [0, 1, 0, 1], [mean, 0.5], by)
    assert got[0] == got[2] == 0 and got[1] < 0 < got[3]


def test_comparison_by_hand():
    scores, family, incumbents = [190, -80, 200, -100, 170, NAN], [0, 1, 0, 1, 0, 1], [185, -90]
    got, _ = compare(scores, family, incumbents, "advantage")
    np.testing.assert_array_equal(got, [5, 10, 15, -10, -15, NAN])
    # 190, 200, 170 beat 1, 2 and 0 of 3, and count half of themselves; the incumbent's 185 beats 1.
    # -80 and -100 beat 1 and 0 of 3, and half of themselves; the incumbent's -90 beats 1.
    got, _ = compare(scores, family, incumbents, "rank")
    np.testing.assert_allclose(got, np.array([0.5, 0.5, 1.5, -0.5, -0.5, NAN]) / 3, rtol=1e-5)


@pytest.mark.parametrize("by", COMPARED_BY)
def test_a_family_none_of_whose_agents_survived_moves_nothing(by):
    got, _ = compare([3, NAN, 5, NAN], [0, 1, 0, 1], [4, NAN], by)
    np.testing.assert_array_equal(np.sign(got), [-1, NAN, 1, NAN])


@pytest.mark.parametrize("by", COMPARED_BY)
def test_scores_of_one_family_stay_as_they_are(by):
    got, incumbent = compare(SCORES, np.zeros(12, int), [7.5], by)
    np.testing.assert_array_equal(got, SCORES)
    assert incumbent == 7.5


@pytest.mark.parametrize(
    ("means", "mean", "worst"),
    [((200.0, 140.0), 170.0, 140.0), ((-90.0, NAN), NAN, NAN), ((3.0,), 3.0, 3.0)],
)
def test_an_incumbent_is_worth_its_mean_or_its_worst_family(means, mean, worst):
    for aggregate, expected in (("mean", mean), ("min", worst)):
        got = families(len(means), aggregate=aggregate).aggregated(jnp.array(means))
        np.testing.assert_array_equal(got, expected)


def test_the_incumbents_agents_that_diverged_rank_last_within_their_family():
    # 4 members, two of each family, then the incumbent's three agents of each, by turns.
    returns = jnp.array([9.0, -50, 7, -60, 1, -10, NAN, NAN, 4, -30])[:, None]
    counts = jnp.ones(10, jnp.int32)
    outcome = Outcome(
        test_returns=returns, scored_returns=returns, train_steps=counts, train_episodes=counts,
        auc=returns[:, 0], nonfinite=counts < 0, real_steps=counts,
    )  # fmt: skip
    scoring = Scoring(
        objective=MaxReward().make(TASK), mixture=families(2),
        evaluations=Trials(num_incumbent_evals=6), agent_of_member=np.array([0, 1] * 2),
        agent_of_evaluation=np.array([0, 1] * 5),
    )  # fmt: skip
    got = scoring.of_whole_tests(outcome)
    # The lowest of family 0 is 1, of family 1 -60.
    np.testing.assert_array_equal(got.incumbent, [1, -10, 1, -60, 4, -30])
    np.testing.assert_allclose(got.agent_means, [2, -100 / 3])
    np.testing.assert_allclose(got.incumbent_mean, (2 - 100 / 3) / 2, rtol=1e-6)


# --- programs ------------------------------------------------------------------------------------

PROXY = registry.make("proxy", SyntheticConfig(hidden_size=4, done="threshold"), TASK)
TRAINING = TrainingConfig(max_episodes=5, max_steps=30, stop_rule="never", test_episodes=2)
ES = NESConfig(population_size=3, noise_std=1.0, num_evals=2, num_incumbent_evals=3)
KEY = jax.random.key(0)


def program_of(agent, **fields):
    return make_bilevel(
        **{"task": TASK, "agent": agent, "proxy": PROXY, "es": ES, "training": TRAINING,
           "num_parallel": 1, "devices": 2, **fields}
    )  # fmt: skip


@pytest.fixture(scope="module")
def two():
    """A program of two families, its first generation, and that generation's outcome by hand.

    The outcome is of one training after another, each with a single agent's evaluator.
    """
    program = program_of(Families(agents=AGENTS, names=("q", "sarsa"), weights=(2.0, 1.0)))
    state = program.init(KEY)
    asked, after, info = jax.jit(lambda s: (program.ask(s), *program.generation(s)))(state)
    by_agent = []
    for agent in AGENTS:
        evaluate = make_evaluator(agent, PROXY, TASK, TRAINING)

        def one(trial, evaluate=evaluate):
            key, candidate = trial
            return evaluate(key, PROXY.params(program.unravel(candidate)))

        trials = asked.keys, asked.params
        by_agent.append(jax.device_get(jax.jit(lambda x, one=one: jax.lax.map(one, x))(trials)))
    # Members 0 1 0 of each sign, two trials each; four of the incumbent, three rounded up.
    family = np.array([0, 0, 1, 1, 0, 0] * 2 + [0, 1, 0, 1])

    def chosen(*leaves):
        return np.stack([leaves[f][i] for i, f in enumerate(family)])

    # Each family makes something else of most candidates.
    assert np.mean(by_agent[0].auc != by_agent[1].auc) > 0.5
    return SimpleNamespace(
        program=program, before=state, asked=asked, after=after, info=info, family=family,
        outcome=jax.tree.map(chosen, *by_agent),
    )  # fmt: skip


def test_each_candidate_is_trained_by_its_family_and_no_other(two):
    got = jax.jit(two.program.evaluate)(two.asked)
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(got), two.outcome)


def test_a_generation_tells_the_advantages_over_each_familys_incumbent(two):
    scores, family, asked, after = two.outcome.test_return, two.family, two.asked, two.after
    assert np.isfinite(scores).all()
    assert (np.asarray(after.es_state.mean) != two.before.es_state.mean).any()
    of_family = [scores[12:][family[12:] == i].mean() for i in range(2)]
    members = scores[:12].reshape(6, 2).mean(axis=1)
    advantage = members - np.array([of_family[i] for i in (0, 1, 0, 0, 1, 0)])
    told = two.program.strategy.tell(
        asked.key_tell, asked.population, jnp.float32(advantage), jnp.float32(0), asked.es_state
    )
    np.testing.assert_allclose(after.es_state.mean, told.mean, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(two.info.incumbent_mean, np.mean(of_family), rtol=1e-6)
    np.testing.assert_allclose(after.best_scores, of_family, rtol=1e-6)
    np.testing.assert_allclose(after.incumbent_scores, of_family, rtol=1e-6)


def test_the_columns_of_each_family_are_means_over_its_trainings(two):
    info, outcome, family = two.info, two.outcome, two.family
    scores = outcome.test_return
    for i in range(2):
        own, member = family == i, np.arange(16) < 12
        for name, expected in {
            "incumbent_mean": scores[own & ~member].mean(),
            "population_mean": scores[own & member].mean(),
            "train_steps_mean": outcome.train_steps[own].mean(),
            "num_nonfinite": 0,
        }.items():
            got = getattr(info.by_agent, name)
            assert got.shape == (2,)
            np.testing.assert_allclose(got[i], expected, rtol=1e-5, err_msg=name)
    np.testing.assert_allclose(info.population_mean, scores[:12].mean(), rtol=1e-6)
    np.testing.assert_allclose(info.population_max, scores[:12].max(), rtol=1e-6)
    np.testing.assert_allclose(info.incumbent_std, scores[12:].std(), rtol=1e-5)
    np.testing.assert_allclose(info.train_episodes_mean, outcome.train_episodes.mean(), rtol=1e-6)
    np.testing.assert_array_equal(info.train_steps_max, outcome.train_steps.max())
    np.testing.assert_array_equal(info.train_steps, outcome.train_steps)
    np.testing.assert_array_equal(info.real_steps, outcome.real_steps)


def program_text(program):
    state = jax.eval_shape(program.init, KEY)
    return re.sub("0x[0-9a-f]+", "", str(jax.make_jaxpr(program.generation)(state)))


def test_one_family_is_the_program_of_its_agent():
    alone = program_text(program_of(AGENTS[0]))
    config = FamiliesConfig(compared_by="rank")
    family = Families(agents=AGENTS[:1], names=("q",), weights=(3.0,), config=config)
    assert program_text(program_of(family)) == alone
    assert program_text(program_of(AGENTS[1])) != alone


# --- solved by all -------------------------------------------------------------------------------


def told(scores, incumbents, state=None, stop_when_solved=True, **config):
    """State and info after a generation whose test returns these were."""
    group = Families(agents=AGENTS, config=FamiliesConfig(**config))
    program = program_of(
        group, stop_when_solved=stop_when_solved,
        es=NESConfig(population_size=2, mirrored=False, num_incumbent_evals=2),
    )  # fmt: skip
    returns = np.concatenate([scores, incumbents]).astype(np.float32)
    counts = np.full(returns.shape, 3, np.int32)
    outcome = Outcome(
        test_returns=returns[..., None], scored_returns=returns[..., None], train_steps=counts,
        train_episodes=counts, auc=returns, nonfinite=~np.isfinite(returns),
        real_steps=counts,
    )  # fmt: skip
    state = program.init(KEY) if state is None else state
    return jax.jit(lambda s: program.tell(s, program.ask(s), outcome))(state)


@pytest.mark.parametrize("above", [(0.75, -0.25), (0.5, 0.0)])
@pytest.mark.parametrize("aggregate", ["mean", "min"])
def test_a_run_stops_when_the_aggregated_score_of_the_incumbent_solves_the_task(aggregate, above):
    # The mean is above the threshold; in the first case one agent's is below it.
    incumbents = TASK.solved_reward + np.array(above)
    after, info = told(np.zeros(2), incumbents, aggregate=aggregate)
    assert after.finished == (aggregate == "mean" or min(above) >= 0)
    worth = incumbents.mean() if aggregate == "mean" else incumbents.min()
    np.testing.assert_allclose(after.best_score, worth, rtol=1e-6)
    np.testing.assert_allclose(info.by_agent.incumbent_mean, incumbents, rtol=1e-6)


def test_solved_runs_go_on_unless_asked_to_stop():
    solved = np.full(2, TASK.solved_reward + 1)
    after, _ = told(np.zeros(2), solved, stop_when_solved=False)
    assert not after.finished and after.best_score > TASK.solved_reward


def test_of_equally_good_incumbents_the_last_is_kept():
    first, _ = told(np.zeros(2), [0.25, 0.0])
    same, _ = told(np.zeros(2), [0.25, 0.0], first)
    assert same.best_generation == 1 and same.best_score == first.best_score
    np.testing.assert_array_equal(same.best, same.incumbent)
    worse, _ = told(np.zeros(2), [0.0, 0.0], first)
    assert worse.best_generation == 0


def test_an_incumbent_that_no_agent_of_a_family_survived_is_never_the_best():
    after, info = told(np.zeros(2), [1e6, NAN])
    assert after.best_generation == -1 and after.best_score == -INF and not after.finished
    np.testing.assert_array_equal(after.incumbent_scores, [1e6, -INF])
    np.testing.assert_array_equal(info.by_agent.num_nonfinite, [0, 1])
    assert info.num_nonfinite == 1


# --- what the compiler makes ---------------------------------------------------------------------


def test_two_families_are_one_program_with_a_training_loop_for_each():
    task = envs.make("cartpole")
    config = sejax.DDQNConfig(hidden_size=4, num_layers=1, batch_size=4, warmup_episodes=1)
    sizes = (31, 37)  # rows of the replay buffers, which tell the loops apart
    agents = tuple(
        sejax.make_agent(dataclasses.replace(config, buffer_size=size), task) for size in sizes
    )
    program = make_bilevel(
        task=task, agent=Families(agents=agents), proxy=SyntheticConfig(hidden_size=4),
        es=NESConfig(population_size=7), training=dataclasses.replace(TRAINING, max_steps=40),
        devices=2, num_parallel=1,
    )  # fmt: skip
    lowered = jax.jit(program.generation).lower(jax.eval_shape(program.init, KEY))
    hlo = lowered.compile().as_text()
    assert "num_partitions=2" in hlo.splitlines()[0]
    loops = [line for line in hlo.splitlines() if re.search(r"\) while\(", line)]
    for size in sizes:
        assert sum(f"f32[{size},11]" in line for line in loops) == 1
    assert not any(all(f"f32[{size},11]" in line for size in sizes) for line in loops)
    # No training pays for another family's: a device runs half of 8 members and 4 incumbents of the
    # first, and of 6 and 4 of the second. Other loops draw random numbers.
    trips = [int(n) for line in loops for n in re.findall(r'known_trip_count.*?"n":"(\d+)"', line)]
    assert {5, 6} <= set(trips) and max(trips) <= 8
